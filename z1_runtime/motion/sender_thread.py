"""Sending of chunks on a thread of its own."""

from __future__ import annotations

from collections.abc import Callable

from hal.base.background_loop import BackgroundLoop
from hal.base.clock import Clock
from hal.base.errors import Z1Error


class SenderThread(BackgroundLoop):
    """A thread of its own for a sender: whatever the caller does meanwhile, such as logging, delays no chunk."""

    def __init__(self, send: Callable[[Clock, Callable[[], bool]], None], clock: Clock) -> None:
        super().__init__("chunk sender")
        self._send, self._clock = send, clock
        self.error: Z1Error | None = None
        """The error that ended the sending; the executor raises it."""

    def _run(self) -> None:
        try:
            self._send(self._clock, self._stop_requested.is_set)
        except Z1Error as error:
            self.error = error

    def raise_error(self) -> None:
        """Raise the error that ended the sending, if there is one."""
        if self.error is not None:
            raise self.error
