"""Rig of the real robot: the Z1 behind the vendor's controller, and the D405 on its wrist."""

from __future__ import annotations

from typing import Any

from hal.backends.d405.session import D405CameraConfig
from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig
from hal.base.clock import WallClock
from hal.parking import Parking
from hal.rig import CAMERAS, Rig
from hal.z1_protocol.controller import LABELS

SEARCH_S = 1.0
"""Search time for arm and camera [s]; short, so that a machine with neither reports both within 3 s."""


def make_rig(*, arm: Z1ArmConfig | None = None, camera: Any = None, **_: Any) -> Rig:
    """Return the rig of the real robot, on the wall clock.

    Args:
        arm: configuration of the arm.
        camera: a `hal.backends.d405.session.D405CameraConfig`.
        **_: options of other rigs.
    """
    clock = WallClock()
    z1_arm = Z1Arm(clock, arm or Z1ArmConfig(connect_timeout_s=SEARCH_S))
    return Rig(
        arm=z1_arm,
        camera=CAMERAS.make("d405", clock=clock, config=camera or D405CameraConfig(search_s=SEARCH_S)),
        clock=clock,
        independent=True,
        park=Parking(q=LABELS["startFlat"], disable_motors=z1_arm.go_passive),
    )
