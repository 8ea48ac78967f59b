"""Rig of the real robot: the Z1 behind the vendor's controller, and the D405 on its wrist."""

from __future__ import annotations

from typing import Any

from hal.backends.d405.session import D405CameraConfig
from hal.backends.mixed_rig import make_mixed_rig
from hal.backends.z1.config import Z1ArmConfig
from hal.rig import Rig


def make_rig(*, arm: Z1ArmConfig | None = None, camera: D405CameraConfig | None = None, **_: Any) -> Rig:
    """Return the rig of the real robot, on the wall clock.

    Args:
        arm: configuration of the arm.
        camera: configuration of the camera.
        **_: options of other rigs.
    """
    return make_mixed_rig("z1", "d405", z1=arm, d405=camera)
