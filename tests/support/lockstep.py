"""A mock arm under the real servo on a clock that ticks it during every sleep: seconds of motion in milliseconds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hal.backends.mock_arm import MockArm
from hal.base import z1
from hal.base.clock import ManualClock
from hal.servo.servo import Servo


class TickingClock(ManualClock):
    """Time moves only in `sleep_until`, by control periods, and everything in `each_tick` is called after each."""

    def __init__(self) -> None:
        super().__init__()
        self.each_tick: list[Callable[[], None]] = []

    def sleep_until(self, t_s: float) -> None:
        while self.now_s() < t_s - 1e-9:
            self.advance(z1.CONTROL_PERIOD_S)
            for call in self.each_tick:
                call()


class Bench:
    """A connected arm whose lease is held; its joints start at `q` (7,) [rad]."""

    def __init__(self, q: np.ndarray) -> None:
        self.clock = TickingClock()
        self.mock = MockArm(self.clock, q=q)
        self.servo = Servo(self.mock, self.clock)
        self.servo.connect()
        self.servo.claim("test")
        self.clock.each_tick.append(self.servo.tick)

    def at_time(self, t_s: float, call: Callable[[], object]) -> None:
        """Call `call` once, at the first tick `t_s` [s] from now."""
        due_s = self.clock.now_s() + t_s
        pending = [call]

        def call_when_due() -> None:
            if pending and self.clock.now_s() >= due_s:
                pending.pop()()

        self.clock.each_tick.append(call_when_due)

    def wait(self, seconds: float) -> None:
        self.clock.sleep_until(self.clock.now_s() + seconds)
