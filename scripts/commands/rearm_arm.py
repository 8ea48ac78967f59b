"""`./z1 rearm`: lift the latched stop, after inspecting the arm. It holds its position."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from hal.base.messages import ServoMode
from hal.bus.client import RemoteArm
from hal.bus.session import BusConfig
from scripts.commands.stop_arm import describe, wait_for_mode


@dataclass(frozen=True, kw_only=True)
class RearmConfig:
    """Address of the HAL."""

    bus: Annotated[BusConfig, tyro.conf.arg(name="")] = field(default_factory=BusConfig)


Config = RearmConfig


def main(config: RearmConfig) -> int:
    """Rearm and print the servo's status; return 1 if the stop was latched again at once.

    Raises:
        HalTimeoutError: no HAL process answers.
    """
    with RemoteArm(config.bus, owner="rearm command") as arm:
        arm.rearm()
        status = wait_for_mode(arm.status, ServoMode.HOLDING)
    print(describe(status))
    # A cause that persists, such as a fault, latches again
    return 1 if status.mode is ServoMode.STOPPED else 0
