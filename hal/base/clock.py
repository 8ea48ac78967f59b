"""The one place that reads the time or sleeps; everyone else is handed a `Clock`.

On the robot that clock is the wall's, in a test it is moved by hand, and in lock-step it is the twin's
(`sim_twin.clock.TwinClock`), so that a whole episode is a pure function of its seed.
"""

from __future__ import annotations

import time
from typing import Protocol

_OTHERS_BEGAN_S = 1.6e9  # long after 1970: librealsense takes small stamps for nonsense and no longer pairs frames


class Clock(Protocol):
    """Monotonic time in seconds."""

    def now_s(self) -> float:
        """Return the present time [s]; never goes back."""
        ...

    def sleep_until(self, t_s: float) -> None:
        """Return once `now_s() >= t_s` (at once if that is past)."""
        ...


class WallClock:
    """CLOCK_MONOTONIC; the same for all processes of one machine."""

    def now_s(self) -> float:
        return time.monotonic()

    def sleep_until(self, t_s: float) -> None:
        # time.sleep() itself waits on an absolute monotonic deadline, so lateness does not add up.
        while (left := t_s - time.monotonic()) > 0:
            time.sleep(left)


def unix_offset_s(clock: Clock) -> float:
    """Return what to add to a time of `clock` to get Unix time [s].

    Only for devices that stamp their data with the system's time, which may jump: ask each time. Clocks other than the
    wall's begin at one fixed moment.
    """
    return time.time() - time.monotonic() if isinstance(clock, WallClock) else _OTHERS_BEGAN_S


class ManualClock:
    """A clock for tests: it moves only when told, or when somebody sleeps on it."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s

    def now_s(self) -> float:
        return self._now_s

    def sleep_until(self, t_s: float) -> None:
        self._now_s = max(self._now_s, t_s)

    def advance(self, dt_s: float) -> None:
        """Move on by `dt_s` [s]."""
        self._now_s += dt_s


class Stopwatch:
    """How long something took, in real milliseconds, for reports only; nothing may be decided by it."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    def lap_ms(self) -> float:
        """Return the real time [ms] since the last lap, and start the next."""
        now = time.perf_counter()
        elapsed, self._start = now - self._start, now
        return 1e3 * elapsed
