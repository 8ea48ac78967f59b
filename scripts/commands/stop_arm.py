"""`./z1 stop`: the arm brakes, holds, and rejects every command until `./z1 rearm`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from hal.base.clock import WallClock
from hal.base.messages import ServoMode, ServoStatus
from hal.bus import keys
from hal.bus.codec import decode
from hal.bus.link import BusLink
from hal.bus.session import BusConfig


@dataclass(frozen=True, kw_only=True)
class StopConfig:
    """Address of the HAL, and the reason."""

    reason: str = "./z1 stop"
    """Reason in the arm's status."""
    bus: Annotated[BusConfig, tyro.conf.arg(name="")] = field(default_factory=BusConfig)


Config = StopConfig

_BRAKING_S = 2.0  # five times the longest braking, 0.4 s


def main(config: StopConfig) -> int:
    """Stop the arm and print the servo's status.

    Raises:
        HalTimeoutError: no HAL process answers.
    """
    # Not `RemoteArm`, which waits for the arm's first state: a stop must reach an arm that sends none.
    link = BusLink(config.bus, WallClock(), "the arm")
    try:
        link.request(keys.STOP, config.reason.encode(), "stop command")
        status = wait_for_mode(lambda: decode(link.request(keys.READ_STATUS), ServoStatus), ServoMode.STOPPED)
    finally:
        link.close()
    print(describe(status))
    if status.mode is not ServoMode.STOPPED:
        print("error: stop: the arm is not at rest. Use the switch on the arm.", file=sys.stderr)
        return 1
    print("nothing moves until the operator has inspected the arm and typed: ./z1 rearm")
    return 0


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
