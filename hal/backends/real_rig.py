"""The real robot: the Z1 behind the vendor's controller, and the D405 on its wrist."""

from __future__ import annotations

from typing import Any

from hal.backends.z1_config import Z1ArmConfig
from hal.clock import WallClock
from hal.registry import ARMS, CAMERAS
from hal.rig import Rig


def make_rig(*, arm: Z1ArmConfig | None = None, camera: Any = None, **_: Any) -> Rig:
    """Return the rig of the real robot, on the wall clock.

    Args:
        arm: where the controller is and how to use it.
        camera: a `hal.backends.d405_camera.D405CameraConfig`.
        **_: options of other rigs.
    """
    clock = WallClock()
    return Rig(
        arm=ARMS.make("z1", clock=clock, config=arm),
        camera=CAMERAS.make("d405", clock=clock, config=camera),
        clock=clock,
    )
