"""Threads that receive: one for each acked query, so that no service ever waits for another, one for each topic.

Zenoh's own callbacks are not used: they run on threads that are not daemons, for which a program that ends with its
session still open would wait for ever.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from threading import Thread, current_thread
from typing import Any

import zenoh

from hal.base.errors import HalError, InvalidMessageError
from hal.bus.codec import decode_text
from hal.bus.error_codec import encode_error

_LOG = logging.getLogger(__name__)
_WAITING = 32
"""How many queries may wait for one service; beyond that the oldest are dropped, and their askers time out."""

Answer = Callable[[str, bytes], bytes]
"""Takes the asker's name and the payload, returns the answer's payload; a `HalError` goes back as itself."""


def receive_items(handler: Any) -> Iterator[Any]:
    """Yield what `handler` receives until it is undeclared.

    The handler, not its queryable or subscriber, is what a thread may wait on: Zenoh 1.10 refuses to undeclare what
    another thread is receiving on.
    """
    while True:
        try:
            item = handler.recv()
        except zenoh.ZError:  # closed
            return
        yield item


class ServiceThread(Thread):
    """A daemon thread that reports it when it dies of something nobody expected, and lets the error show."""

    def __init__(self, name: str, run: Callable[[], None], on_failure: Callable[[], None]) -> None:
        super().__init__(name=name, daemon=True)
        self._work = run
        self._on_death = on_failure

    def run(self) -> None:
        ended = False
        try:
            self._work()
            ended = True
        finally:
            if not ended:
                self._on_death()


class Listener:
    """A subscriber and the thread that takes its samples.

    Args:
        session: open Zenoh session.
        key: what is listened to.
        take: called with each sample.
        waiting: how many samples may wait; beyond that the oldest are dropped.
        on_death: called when the thread dies of an unexpected error.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        take: Callable[[zenoh.Sample], None],
        *,
        waiting: int = 1,
        on_failure: Callable[[], None] = lambda: None,
    ) -> None:
        self._take = take
        self._closing = False
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(waiting))
        self._thread = ServiceThread(f"bus {key}", self._run, on_failure)
        self._thread.start()

    def close(self) -> None:
        """Listen no more; waits for the sample in hand, except when called by `take` itself."""
        self._closing = True
        self._subscriber.undeclare()
        if self._thread is not current_thread():
            self._thread.join()

    def _run(self) -> None:
        for sample in receive_items(self._subscriber.handler):
            if self._closing:  # what was still waiting
                return
            self._take(sample)


class Service:
    """A queryable and the thread that answers it.

    Args:
        session: open Zenoh session.
        key: where it is asked.
        answer: what it does.
        on_death: called when the thread dies of an unexpected error.
        heed_anyone: serve a query whose asker's name cannot be read, too (the stop).
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        answer: Answer,
        on_failure: Callable[[], None],
        *,
        allow_anonymous: bool = False,
    ) -> None:
        self._key = key
        self._answer = answer
        self._allow_anonymous = allow_anonymous
        # A ring, not a FIFO: a full FIFO would hold up the thread that receives for the whole session.
        self._queryable = session.declare_queryable(key, zenoh.handlers.RingChannel(_WAITING))
        self._thread = ServiceThread(f"bus {key}", self._run, on_failure)
        self._thread.start()

    def close(self) -> None:
        """Answer no more; waits for the answer in hand."""
        self._queryable.undeclare()
        self._thread.join()

    def _run(self) -> None:
        for query in receive_items(self._queryable.handler):
            with query:
                self._serve(query)

    def _serve(self, query: zenoh.Query) -> None:
        try:
            reply = self._answer(self._requester(query), as_bytes(query.payload))
        except HalError as error:
            if isinstance(error, InvalidMessageError):
                _LOG.warning("%s: refused a malformed request: %s", self._key, error)
            refusal = encode_error(error)
            self._send(lambda: query.reply_err(refusal))
        else:
            self._send(lambda: query.reply(self._key, reply, express=True))

    def _requester(self, query: zenoh.Query) -> str:
        try:
            return decode_text(as_bytes(query.attachment), "the asker's name")
        except InvalidMessageError:
            if self._allow_anonymous:
                return ""
            raise

    def _send(self, reply: Callable[[], None]) -> None:
        try:
            reply()
        except zenoh.ZError as err:  # the asker is gone, or the session is being closed
            _LOG.debug("%s: the answer did not get out: %s", self._key, err)


def as_bytes(payload: zenoh.ZBytes | None) -> bytes:
    """Return a payload or attachment as bytes; empty when there is none."""
    return b"" if payload is None else payload.to_bytes()
