"""Supervised threads: a worker with start, stop and a `with` block, and restarts of work that fails.

An error in a thread is always reported: it restarts the work, a few times, and then reaches `on_failure` and the
caller that stops the thread.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from hal.base.clock import Clock, WallClock

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class RestartPolicy:
    """Limit of the restarts of work that fails."""

    max_restarts: int = 3
    """Number of restarts within `window_s`; the next failure is final."""
    window_s: float = 60.0
    """Time after which a restart is forgotten [s]."""
    pause_s: float = 0.1
    """Time between a failure and the restart [s]: work that fails at once must not occupy a core."""


class RestartBudget:
    """A count of the failures of one piece of work.

    Args:
        policy: the limit.
        clock: source of time.
    """

    def __init__(self, policy: RestartPolicy, clock: Clock) -> None:
        self._policy, self._clock = policy, clock
        self._failed_s: deque[float] = deque()

    def allows_restart(self) -> bool:
        """Record a failure; return True while the work may be started again."""
        now_s = self._clock.now_s()
        self._failed_s.append(now_s)
        while self._failed_s[0] < now_s - self._policy.window_s:
            self._failed_s.popleft()
        return len(self._failed_s) <= self._policy.max_restarts


def run_supervised(
    name: str,
    work: Callable[[], None],
    on_failure: Callable[[str], None],
    *,
    policy: RestartPolicy = RestartPolicy(),
    clock: Clock | None = None,
    stop_requested: threading.Event | None = None,
) -> Exception | None:
    """Run `work` to its end, and again after each error as often as `policy` allows; return the last error if not.

    For the body of a thread. Whatever `on_failure` does, such as a stop of the arm, it gets the reason.

    Args:
        name: of the work, for logs and the reason.
        work: returns when it is done; called again after an error.
        on_failure: called once, with the reason, when the work is given up.
        policy: limit of the restarts.
        clock: source of time; None = the wall clock.
        stop_requested: ends the restarts.
    """
    budget, ended = RestartBudget(policy, clock or WallClock()), stop_requested or threading.Event()
    while True:
        try:
            work()
        except Exception as error:  # every type: a defect in one thread must not end the process that holds the arm
            text = f"the {name} thread failed: {type(error).__name__}: {error}"
            if ended.is_set():
                _LOG.exception("%s, while it was stopped", text)
                return error
            if not budget.allows_restart():
                _LOG.exception("%s; it is given up after %d restarts", text, policy.max_restarts)
                on_failure(text)
                return error
            _LOG.exception("%s; it is started again", text)
            ended.wait(policy.pause_s)
        else:
            return None


class BackgroundLoop:
    """A daemon thread around `_run`, which returns soon after `_stop_requested` is set.

    Args:
        name: of the thread, for logs and debuggers.
        restarts: number of times that a failed `_run` is started again; by default none.
        on_failure: called with the reason when the thread has failed for good.
    """

    def __init__(
        self, name: str, *, restarts: RestartPolicy | None = None, on_failure: Callable[[str], None] = lambda _: None
    ) -> None:
        self._name = name
        self._restarts = restarts or RestartPolicy(max_restarts=0)
        self._on_failure = on_failure
        self._stop_requested = threading.Event()
        self._thread: threading.Thread | None = None
        self._error: Exception | None = None

    def start(self) -> None:
        """Start the thread. No effect while it runs."""
        if self._thread is not None:
            return
        self._stop_requested.clear()
        self._error = None
        self._thread = threading.Thread(target=self._run_and_keep_error, name=self._name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread and wait for it. No effect when it was not started.

        Raises:
            Exception: the error that ended the thread before.
        """
        if self._thread is None:
            return
        self._stop_requested.set()
        self._thread.join()
        self._thread = None
        if self._error is not None:
            raise self._error

    @property
    def is_running(self) -> bool:
        """True while the thread runs: started, neither stopped nor ended by an error."""
        return self._thread is not None and self._thread.is_alive()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _run(self) -> None:
        """Do the work of the thread."""
        raise NotImplementedError

    def _run_and_keep_error(self) -> None:
        self._error = run_supervised(
            self._name, self._run, self._on_failure, policy=self._restarts, stop_requested=self._stop_requested
        )
