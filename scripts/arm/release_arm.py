"""`./z1 release-arm`: let go of an arm that a keeper holds after its HAL has ended. Support the arm first: it sinks.

    ./z1 release-arm          show the posture that is held, and ask
    ./z1 release-arm --yes    without asking

A keeper remains when a HAL ends, or is killed, with the arm not parked. `./z1 hal --real` takes the arm over instead.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field

from hal.backends.z1.config import Z1ArmConfig
from hal.backends.z1.keeper import control

_FREE_JAW_NM = 0.3
_WORD = "limp"


@dataclass(frozen=True, kw_only=True)
class ReleaseConfig:
    """Address of the arm's driver."""

    arm: Z1ArmConfig = field(default_factory=Z1ArmConfig)
    """Address that the HAL used."""
    yes: bool = False
    """Do not ask."""


Config = ReleaseConfig


def main(config: ReleaseConfig) -> int:
    """Release the arm and return 0; 1 when no keeper holds one, or the operator does not confirm.

    Raises:
        CommandRejectedError: a HAL commands the arm.
        HalTimeoutError: the controller does not let it go.
    """
    local = config.arm.local_host, config.arm.state_port
    keeper = control.find(local)
    if keeper is None:
        print(f"no keeper holds an arm at port {local[0]}:{local[1]}: nothing was released", file=sys.stderr)
        return 1
    joints = ", ".join(f"{angle:.2f}" for angle in keeper.q) or "not measured yet"
    print(f"keeper {keeper.pid} ({keeper.phase}) of process {keeper.owner_pid}; joints and gripper [rad]: {joints}")
    if abs(keeper.grip_nm) > _FREE_JAW_NM:
        print(f"the jaws hold something ({keeper.grip_nm:.1f} Nm); it will drop")
    if not config.yes and input(f"The arm will sink: support it, then type {_WORD!r}: ").strip() != _WORD:
        print("nothing was released", file=sys.stderr)
        return 1
    control.release(local)
    print("the arm is limp")
    return 0
