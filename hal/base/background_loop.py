"""A worker thread with start, stop and a `with` block; its error is raised where it is stopped."""

from __future__ import annotations

import logging
import threading
from types import TracebackType
from typing import Self

_LOG = logging.getLogger(__name__)


class BackgroundLoop:
    """A daemon thread around `_run`, which returns soon after `_stop_requested` is set.

    Args:
        name: of the thread, for logs and debuggers.
    """

    def __init__(self, name: str) -> None:
        self._name = name
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
        try:
            self._run()
        except Exception as error:  # every type: a bug in the loop has to reach the caller of `stop`
            self._error = error
            _LOG.exception("the %s thread failed", self._name)
