"""What to do about a camera that has fallen silent, and about its idea of the time."""

from __future__ import annotations

import logging
from enum import Enum

logger = logging.getLogger(__name__)


class Rung(Enum):
    """One attempt to get frames again, each harder than the one before."""

    RESTART = "its streams were started anew"
    RESET = "its hardware was reset"
    SEARCH = "it is looked for on the bus"


class ResetLadder:
    """Climbs a rung each time somebody has waited `silence_s` [s] in vain: restart, reset, then search.

    Silence counts only while somebody waits, so a camera that nobody asks is never reset.
    """

    def __init__(self, silence_s: float) -> None:
        self._silence_s = silence_s
        self._silent_s = 0.0
        self._rung: Rung | None = None

    @property
    def rung(self) -> Rung | None:
        """The last rung climbed; None while all is well."""
        return self._rung

    def heard(self) -> None:
        """Frames come: back to the ground."""
        self._silent_s, self._rung = 0.0, None

    def lost(self) -> None:
        """The device is not on the bus: nothing is left but to look for it."""
        self._rung = Rung.SEARCH

    def found(self) -> None:
        """It is on the bus again and was started; if it stays silent, its hardware is reset."""
        self._silent_s, self._rung = 0.0, Rung.RESTART

    def silent(self, for_s: float) -> Rung | None:
        """Return the rung to climb now that nothing came for another `for_s` [s]; None = wait on."""
        self._silent_s += for_s
        if self._silent_s < self._silence_s - 1e-6:
            return None
        self._silent_s = 0.0
        following = {None: Rung.RESTART, Rung.RESTART: Rung.RESET, Rung.RESET: Rung.SEARCH, Rung.SEARCH: Rung.SEARCH}
        self._rung = following[self._rung]
        return self._rung


class StampKeeper:
    """Turns the device's time into the clock's, tells frames that are too old, and survives jumps of the system's time.

    Frames carry Unix time. When that disagrees with the clock by more than `max_age_s` [s] it is an old frame out of
    some queue, or the system's time has jumped. Old frames come faster than they were taken; after a jump they come
    at their usual pace, and after a few of those the difference is believed.
    """

    _BELIEVE_AFTER = 5
    _JITTER_S = 0.05
    _USUAL_AGE_S = 0.02

    def __init__(self, max_age_s: float) -> None:
        self._max_age_s = max_age_s
        self._correction_s = 0.0
        self._age_s = self._USUAL_AGE_S
        self._odd = 0
        self._last: tuple[float, float] | None = None

    def stamp(self, device_s: float, unix_offset_s: float, now_s: float) -> float | None:
        """Return when the frame was exposed, by the clock [s]; None when it is too old to be used.

        Args:
            device_s: the frame's own time [s].
            unix_offset_s: Unix time minus the clock's [s].
            now_s: the clock's time [s].
        """
        stamp_s = device_s - unix_offset_s + self._correction_s
        last, self._last = self._last, (device_s, now_s)
        if -self._JITTER_S <= now_s - stamp_s <= self._max_age_s:
            self._odd, self._age_s = 0, max(now_s - stamp_s, 0.0)
            return min(stamp_s, now_s)
        if last is not None:
            at_its_pace = device_s > last[0] and now_s - last[1] > 0.5 * (device_s - last[0])
            self._odd = self._odd + 1 if at_its_pace else 0
        if self._odd < self._BELIEVE_AFTER:
            return None
        logger.warning("the camera's time and the system's differ by %.3f s more than before", now_s - stamp_s)
        self._odd = 0
        self._correction_s += now_s - self._age_s - stamp_s
        return now_s - self._age_s
