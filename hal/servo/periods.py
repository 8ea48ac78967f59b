"""How evenly the servo ticks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.base.z1 import CONTROL_PERIOD_S

_SUMMARY_TICKS = 500


class PeriodSummary(NamedTuple):
    """What the last periods amount to; zeros while nothing is measured. All but the rate are values that occurred."""

    rate_hz: float = 0.0
    """Cycles a second."""
    p50_ms: float = 0.0
    p99_ms: float = 0.0
    p999_ms: float = 0.0
    max_ms: float = 0.0


class PeriodStatistics:
    """A ring of the last measured periods; recording allocates nothing, percentiles are computed on request."""

    def __init__(self, capacity: int = 30_000) -> None:
        self._ring_s = np.zeros(capacity)
        self._filled = 0
        self._next = 0
        self._last_s: float | None = None
        self._summary = PeriodSummary()
        self._due_ticks = 0
        self.ticks = 0
        """Cycles since the start."""
        self.overruns = 0
        """Cycles that began more than half a period late, seen from the cycle before."""
        self._measured = False

    def measure(self, on: bool) -> None:
        """Keep the periods from now on, or no more: for a thread on the wall clock that begins or ends its ticks.

        In lock-step a period says nothing about the machine. The time between two threads is no period.
        """
        self._measured, self._last_s = on, None

    def record(self, now_s: float) -> None:
        """A cycle began at `now_s` [s]."""
        self.ticks += 1
        last, self._last_s = self._last_s, now_s
        if last is None:
            return
        period_s = now_s - last
        if period_s > 1.5 * CONTROL_PERIOD_S:
            self.overruns += 1
        if self._measured:
            self._ring_s[self._next] = period_s
            self._next = (self._next + 1) % len(self._ring_s)
            self._filled = min(self._filled + 1, len(self._ring_s))

    def summary(self) -> PeriodSummary:
        """Return what the recorded periods amount to.

        Partitioning the ring takes the interpreter from the tick, so the answer is kept for `_SUMMARY_TICKS`;
        `np.percentile` would take 57 ms for its first call.
        """
        if self._filled and self.ticks >= self._due_ticks:
            self._due_ticks = self.ticks + _SUMMARY_TICKS
            ring_s = self._ring_s[: self._filled]
            ranks = [round(share * (self._filled - 1)) for share in (0.5, 0.99, 0.999, 1.0)]
            parted_ms = 1e3 * np.partition(ring_s, ranks)[ranks]  # nearest rank
            self._summary = PeriodSummary(self._filled / float(ring_s.sum()), *parted_ms.tolist())
        return self._summary
