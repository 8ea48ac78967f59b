"""Recovery of a camera that delivers no frames, and conversion of its time stamps."""

from __future__ import annotations

import logging
from enum import Enum

logger = logging.getLogger(__name__)


class RecoveryStep(Enum):
    """One step of the recovery, each stronger than the one before; the values describe it in messages."""

    RESTART = "its streams were restarted"
    RESET = "its hardware was reset"
    SEARCH = "it is searched for on the bus"


class RecoveryPolicy:
    """Next recovery step after each `silence_s` [s] of waiting without a frame: restart, reset, then search.

    Only time spent waiting for a frame counts, so an idle camera is never reset.
    """

    def __init__(self, silence_s: float) -> None:
        self._silence_s = silence_s
        self._silent_s = 0.0
        self._step: RecoveryStep | None = None

    @property
    def step(self) -> RecoveryStep | None:
        """The last step taken; None while frames arrive."""
        return self._step

    def on_frame(self) -> None:
        """Reset the recovery: a frame arrived."""
        self._silent_s, self._step = 0.0, None

    def on_lost(self) -> None:
        """Continue with the search: the device is not on the bus."""
        self._step = RecoveryStep.SEARCH

    def on_found(self) -> None:
        """Continue after the restart: the device is on the bus again; without frames its hardware is reset next."""
        self._silent_s, self._step = 0.0, RecoveryStep.RESTART

    def on_silence(self, duration_s: float) -> RecoveryStep | None:
        """Return the step to take after another `duration_s` [s] without a frame; None = wait on."""
        self._silent_s += duration_s
        if self._silent_s < self._silence_s - 1e-6:  # rounding of the summed durations
            return None
        self._silent_s = 0.0
        following = {
            None: RecoveryStep.RESTART,
            RecoveryStep.RESTART: RecoveryStep.RESET,
            RecoveryStep.RESET: RecoveryStep.SEARCH,
            RecoveryStep.SEARCH: RecoveryStep.SEARCH,
        }
        self._step = following[self._step]
        return self._step


class StampConverter:
    """Conversion of the device's time stamps to the clock, with detection of old frames and of system time jumps.

    Frames carry Unix time. A difference of more than `max_age_s` [s] from the clock is an old frame from a queue, or a
    jump of the system's time. Queued frames arrive faster than they were exposed; after a jump they arrive at their
    usual rate, and after a few of those the difference is accepted.
    """

    _ACCEPT_AFTER = 5  # frames, 0.17 s at 30 Hz
    _JITTER_S = 0.05  # of the device's time stamps against the system's
    _USUAL_AGE_S = 0.02  # of a frame on arrival, until the first one is measured

    def __init__(self, max_age_s: float) -> None:
        self._max_age_s = max_age_s
        self._correction_s = 0.0
        self._age_s = self._USUAL_AGE_S
        self._offset_count = 0
        self._last: tuple[float, float] | None = None

    def convert(self, device_s: float, unix_offset_s: float, now_s: float) -> float | None:
        """Return the exposure time of a frame by the clock [s]; None when it is too old.

        Args:
            device_s: the device's time stamp [s].
            unix_offset_s: Unix time minus the clock's time [s].
            now_s: the clock's time [s].
        """
        stamp_s = device_s - unix_offset_s + self._correction_s
        last, self._last = self._last, (device_s, now_s)
        if -self._JITTER_S <= now_s - stamp_s <= self._max_age_s:
            self._offset_count, self._age_s = 0, max(now_s - stamp_s, 0.0)
            return min(stamp_s, now_s)  # the jitter may put an exposure after its arrival
        if last is not None:
            at_usual_rate = device_s > last[0] and now_s - last[1] > 0.5 * (device_s - last[0])
            self._offset_count = self._offset_count + 1 if at_usual_rate else 0
        if self._offset_count < self._ACCEPT_AFTER:
            return None
        logger.warning("D405: the offset between camera and system time changed by %.3f s", now_s - stamp_s)
        self._offset_count = 0
        self._correction_s += now_s - self._age_s - stamp_s
        return now_s - self._age_s
