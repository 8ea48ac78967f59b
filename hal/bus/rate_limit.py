"""Limits of rates: how often a service does work, and how often one kind of line is logged."""

from __future__ import annotations

import logging
from threading import Lock

from hal.base.clock import Clock, WallClock
from hal.base.errors import HalError


class TokenBucket:
    """A rate limit that lets a burst pass: the token bucket of packet networks.

    Args:
        rate_hz: tokens added a second.
        burst: maximum number of tokens, and the number at the start.
        clock: source of the time.
    """

    def __init__(self, rate_hz: float, burst: float, clock: Clock) -> None:
        self._rate_hz, self._burst, self._clock = rate_hz, burst, clock
        self._tokens, self._filled_s = burst, clock.now_s()
        self._lock = Lock()

    def take(self, tokens: float = 1.0) -> float:
        """Take `tokens`, and return how long the caller has to wait until they exist [s]; 0 within the burst."""
        with self._lock:
            now_s = self._clock.now_s()
            self._tokens = min(self._burst, self._tokens + self._rate_hz * (now_s - self._filled_s)) - tokens
            self._filled_s = now_s
            return max(0.0, -self._tokens / self._rate_hz)

    def try_take(self) -> bool:
        """Take one token if there is one."""
        with self._lock:
            now_s = self._clock.now_s()
            self._tokens = min(self._burst, self._tokens + self._rate_hz * (now_s - self._filled_s))
            self._filled_s = now_s
            taken = self._tokens >= 1.0
            self._tokens -= taken
            return taken


class LimitedLog:
    """A logger's warnings of one kind, at most one in ten seconds; the next one counts those left out.

    Args:
        log: the module's logger.
        clock: source of the time; None = the wall clock.
    """

    def __init__(self, log: logging.Logger, clock: Clock | None = None) -> None:
        self._log = log
        self._bucket = TokenBucket(0.1, 3.0, clock or WallClock())
        self._left_out = 0

    def warning(self, text: str, *arguments: object) -> None:
        """Log `text % arguments`, or count it."""
        if not self._bucket.try_take():
            self._left_out += 1
            return
        left_out, self._left_out = self._left_out, 0
        suffix = f" ({left_out} more like it were not logged)" if left_out else ""
        self._log.warning(text + suffix, *arguments)


class StateChangeWarning:
    """A warning logged when a failure begins and when it is over, not at every cycle in between."""

    def __init__(self, log: logging.Logger, failure: str) -> None:
        self._log, self._failure = log, failure
        self._kind: tuple[type[HalError], str] | None = None

    def warn(self, error: HalError) -> None:
        """Log `error`, unless the last one was of the same class and code (texts hold stamps and ages)."""
        if self._kind != (kind := (type(error), error.code)):
            self._kind = kind
            self._log.warning("%s: %s", self._failure, error)

    def clear(self) -> None:
        """Log the end of the failure, if there was one."""
        if self._kind is not None:
            self._kind = None
            self._log.info("over: %s", self._failure)
