"""Statistics of the servo's tick periods."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.base.z1 import CONTROL_PERIOD_S

_SUMMARY_TICKS = 500  # one second at 500 Hz, the rate at which health is published
_OVERRUN_PERIODS = 1.5  # a tick later than half a period has moved all later deadlines (`servo_thread`)


class PeriodSummary(NamedTuple):
    """Rate and percentiles of the recorded periods, each a period that occurred; zeros while unmeasured."""

    rate_hz: float = 0.0
    """Ticks per second."""
    p50_ms: float = 0.0
    p99_ms: float = 0.0
    p999_ms: float = 0.0
    max_ms: float = 0.0


class PeriodStatistics:
    """A ring of the last measured periods; recording allocates nothing, percentiles are computed on request.

    Args:
        capacity: periods kept; the default is one minute.
    """

    def __init__(self, capacity: int = 30_000) -> None:
        self._ring_s = np.zeros(capacity)
        self._filled = 0
        self._next = 0
        self._last_s: float | None = None
        self._summary = PeriodSummary()
        self._due_ticks = 0
        self.ticks = 0
        """Ticks since the start."""
        self.overruns = 0
        """Ticks that began more than half a period late, relative to the tick before."""
        self._measuring = False

    def set_measuring(self, on: bool) -> None:
        """Start or stop keeping periods: for a wall-clock thread that begins or ends its ticks.

        In lock-step a period says nothing about the machine. The time between two threads is no period.
        """
        self._measuring, self._last_s = on, None

    def record(self, now_s: float) -> None:
        """Record a tick that began at `now_s` [s]."""
        self.ticks += 1
        last, self._last_s = self._last_s, now_s
        if last is None:
            return
        period_s = now_s - last
        if period_s > _OVERRUN_PERIODS * CONTROL_PERIOD_S:
            self.overruns += 1
        if self._measuring:
            self._ring_s[self._next] = period_s
            self._next = (self._next + 1) % len(self._ring_s)
            self._filled = min(self._filled + 1, len(self._ring_s))

    def summary(self) -> PeriodSummary:
        """Return rate and percentiles of the recorded periods.

        Partitioning the ring takes the interpreter from the tick, so the result is cached for `_SUMMARY_TICKS`;
        `np.percentile` would take 57 ms for its first call.
        """
        if self._filled and self.ticks >= self._due_ticks:
            self._due_ticks = self.ticks + _SUMMARY_TICKS
            ring_s = self._ring_s[: self._filled]
            ranks = [round(quantile * (self._filled - 1)) for quantile in (0.5, 0.99, 0.999, 1.0)]
            parted_ms = 1e3 * np.partition(ring_s, ranks)[ranks]  # nearest rank
            self._summary = PeriodSummary(self._filled / float(ring_s.sum()), *parted_ms.tolist())
        return self._summary
