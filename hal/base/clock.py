"""Clocks: the only place that reads the time or sleeps; all other code gets a `Clock`.

On the robot it is the wall clock, in a test it is advanced by hand, and in lock-step it is the twin's
(`sim_twin.backends.TwinClock`), so that a whole episode is a pure function of its seed.
"""

from __future__ import annotations

import time
from typing import Protocol

_SIMULATED_EPOCH_S = 1.6e9  # long after 1970: librealsense treats small stamps as invalid and no longer pairs frames


class Clock(Protocol):
    """Monotonic time in seconds."""

    def now_s(self) -> float:
        """Return the present time [s]; it never decreases."""
        ...

    def sleep_until(self, t_s: float) -> None:
        """Return once `now_s() >= t_s` (at once if that is past)."""
        ...


class WallClock:
    """The machine's CLOCK_MONOTONIC, the same for all its processes."""

    def now_s(self) -> float:
        return time.monotonic()

    def sleep_until(self, t_s: float) -> None:
        # time.sleep() itself waits on an absolute monotonic deadline, so lateness does not add up.
        while (left := t_s - time.monotonic()) > 0:
            time.sleep(left)


def unix_offset_s(clock: Clock) -> float:
    """Return the offset to add to a time of `clock` to get Unix time [s].

    Only for devices that stamp their data with the system's time, which may jump: call it for each conversion. Clocks
    other than the wall's start at one fixed time.
    """
    return time.time() - time.monotonic() if isinstance(clock, WallClock) else _SIMULATED_EPOCH_S


class ManualClock:
    """A clock for tests: it advances only by `advance`, or when a thread sleeps on it."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s

    def now_s(self) -> float:
        return self._now_s

    def sleep_until(self, t_s: float) -> None:
        self._now_s = max(self._now_s, t_s)

    def advance(self, dt_s: float) -> None:
        """Advance by `dt_s` [s]."""
        self._now_s += dt_s


class Stopwatch:
    """A timer of real durations, for reports only; no decision may depend on it."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    def lap_ms(self) -> float:
        """Return the real time [ms] since the last lap, and start the next."""
        now = time.perf_counter()
        elapsed, self._start = now - self._start, now
        return 1e3 * elapsed
