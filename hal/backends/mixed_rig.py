"""Rigs of one arm and one camera by their names, such as the real arm under the twin's camera.

Both run on the wall clock. A camera that renders its arm (`hal.base.camera.ArmFollower`) follows the measured joints of
the rig's arm, whichever that is. Nothing else connects the two: a real camera does not see a simulated arm, and a
simulated object is not in the real jaws.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from hal.backends.d405.session import D405CameraConfig
from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.client import Z1Client
from hal.backends.z1.config import Z1ArmConfig
from hal.base.arm import Arm
from hal.base.camera import ArmFollower, Camera
from hal.base.clock import Clock, WallClock
from hal.parking import Parking
from hal.rig import ARMS, CAMERAS, Rig
from hal.z1_protocol.controller import LABELS
from hal.z1_protocol.link import UdpLink

SEARCH_S = 1.0
"""Search time for arm and camera [s]; short, so that a machine with neither reports both within 3 s."""


def make_mixed_rig(
    arm: str,
    camera: str,
    *,
    scene: Any = None,
    z1: Z1ArmConfig | None = None,
    d405: D405CameraConfig | None = None,
) -> Rig:
    """Return the rig of two devices, not yet connected.

    Args:
        arm: name in `hal.rig.ARMS`.
        camera: name in `hal.rig.CAMERAS`.
        scene: of a simulated device; None = the default one.
        z1: configuration of the real arm.
        d405: configuration of the real camera.

    Raises:
        UnknownBackendError: no device has that name.
    """
    clock = WallClock()
    z1 = z1 or Z1ArmConfig(connect_timeout_s=SEARCH_S)
    options = {
        "sim": {"scene": scene},
        "z1": {"config": z1},
        "d405": {"config": d405 or D405CameraConfig(search_s=SEARCH_S)},
    }
    # The camera first: looking for it must not need an arm
    found: Camera = CAMERAS.make(camera, clock=clock, **options.get(camera, {}))
    made: Arm = ARMS.make(arm, clock=clock, **options.get(arm, {}))
    rig = Rig(
        arm=made,
        camera=found,
        clock=clock,
        follow_arm=found.follow if isinstance(found, ArmFollower) else None,
    )
    return _with_real_arm(rig, made, z1, clock) if isinstance(made, Z1Arm) else rig


def _with_real_arm(rig: Rig, arm: Z1Arm, config: Z1ArmConfig, clock: Clock) -> Rig:
    """Return `rig` with the start and the end of the real arm: search, return of its state, and parking."""

    def find() -> None:
        client = Z1Client(UdpLink((config.host, config.command_port), (config.local_host, config.state_port)), clock)
        client.open(config.connect_timeout_s)
        client.close()

    return replace(
        rig,
        find_arm=find,
        give_back=arm.give_back,
        park=Parking(q=LABELS["startFlat"], disable_motors=arm.go_passive),
    )
