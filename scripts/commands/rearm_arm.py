"""`./z1 rearm`: lift the latched stop, after inspecting the arm. It holds its position."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from hal.base.clock import WallClock
from hal.base.messages import ServoMode, ServoStatus
from hal.bus.client import RemoteArm
from hal.bus.session import BusConfig


@dataclass(frozen=True, kw_only=True)
class RearmConfig:
    """Address of the HAL."""

    bus: Annotated[BusConfig, tyro.conf.arg(name="")] = field(default_factory=BusConfig)


Config = RearmConfig

_BRAKING_S = 2.0  # five times the longest braking, 0.4 s


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


def wait_for_mode(read: Callable[[], ServoStatus], mode: ServoMode) -> ServoStatus:
    """Return the first status that shows `mode`, or the newest one after the longest braking time."""
    clock = WallClock()
    deadline_s = clock.now_s() + _BRAKING_S
    while (status := read()).mode is not mode and clock.now_s() < deadline_s:
        clock.sleep_until(clock.now_s() + 0.01)
    return status


def describe(status: ServoStatus) -> str:
    """Return `status` as one line."""
    reason = f" ({status.reason})" if status.reason else ""
    owner = f", owned by {status.owner}" if status.owner else ""
    return f"servo: {status.mode.value}{reason}{owner}"
