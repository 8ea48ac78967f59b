"""Receiving threads: one for each acked query, so that no service waits for another, and one for each topic.

Zenoh's own callbacks are not used: they run on threads that are not daemons, for which a program that ends with its
session still open would wait forever.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from threading import Event, Thread, current_thread
from typing import Any

import zenoh

from hal.base.background_loop import run_supervised
from hal.base.clock import WallClock
from hal.base.errors import HalError, InvalidMessageError
from hal.bus.authentication import Request, sign_answer
from hal.bus.error_codec import encode_error
from hal.bus.rate_limit import LimitedLog, TokenBucket

_LOG = logging.getLogger(__name__)
_WAITING = 32
"""Maximum number of queries that wait for one service; beyond it the oldest are dropped, and their clients time out."""
_RATE_HZ, _BURST = 1000.0, 100.0
"""Messages that one service or topic takes a second: twice the fastest client's. A flood beyond it is left in the
ring, so that it cannot take the interpreter from the servo."""
_REJECTED_COST = 50.0
"""Messages for which a rejected one counts: 20 a second are answered, and no honest client sends more."""

RequestHandler = Callable[[Request], bytes]
"""Returns the answer's payload; a `HalError` travels back as itself."""


def receive_items(handler: Any) -> Iterator[Any]:
    """Yield the items that `handler` receives until it is undeclared.

    A thread has to wait on the handler, not on its queryable or subscriber: Zenoh 1.10 cannot undeclare one on which
    another thread is receiving.
    """
    while True:
        try:
            item = handler.recv()
        except zenoh.ZError:  # closed
            return
        yield item


class ServiceThread(Thread):
    """A daemon thread that starts its work again after an error, a few times; then `on_failure` is called."""

    def __init__(self, name: str, run: Callable[[], None], on_failure: Callable[[], None]) -> None:
        super().__init__(name=name, daemon=True)
        self._work = run
        self._on_death = on_failure

    def run(self) -> None:
        run_supervised(self.name, self._work, lambda _: self._on_death())


class Listener:
    """A subscriber and the thread that takes its samples.

    Args:
        session: open Zenoh session.
        key: key expression of the topic.
        on_sample: called with each sample.
        waiting: maximum number of samples that wait; beyond it the oldest are dropped.
        on_failure: called when an unexpected error ends the thread.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        on_sample: Callable[[zenoh.Sample], None],
        *,
        waiting: int = 1,
        on_failure: Callable[[], None] = lambda: None,
    ) -> None:
        self._on_sample = on_sample
        self._closing = Event()
        self._bucket = TokenBucket(_RATE_HZ, _BURST, WallClock())
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(waiting))
        self._thread = ServiceThread(f"bus {key}", self._run, on_failure)
        self._thread.start()

    def close(self) -> None:
        """Stop listening; waits for the sample in progress, except when called by `on_sample` itself."""
        self._closing.set()
        self._subscriber.undeclare()
        if self._thread is not current_thread():
            self._thread.join()

    def _run(self) -> None:
        for sample in receive_items(self._subscriber.handler):
            if self._closing.wait(self._bucket.take()):  # samples that were still waiting
                return
            self._on_sample(sample)


class Service:
    """A queryable and the thread that answers it.

    Args:
        session: open Zenoh session.
        key: key expression of the queries.
        handle: answers a query.
        on_failure: called when an unexpected error ends the thread.
        secret: the link's, which signs the answers (`hal.bus.link.link_secret`).
        rate_hz: number of queries answered a second.
        allow_anonymous: also serve a query whose attachment is unreadable (the stop).
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        handle: RequestHandler,
        on_failure: Callable[[], None],
        secret: bytes,
        *,
        rate_hz: float = _RATE_HZ,
        allow_anonymous: bool = False,
    ) -> None:
        self._key = key
        self._handle = handle
        self._secret = secret
        self._allow_anonymous = allow_anonymous
        self._closing = Event()
        self._bucket = TokenBucket(rate_hz, _BURST, WallClock())
        self._rejections = LimitedLog(_LOG)
        # A ring, not a FIFO: a full FIFO would block the thread that receives for the whole session.
        self._queryable = session.declare_queryable(key, zenoh.handlers.RingChannel(_WAITING))
        self._thread = ServiceThread(f"bus {key}", self._run, on_failure)
        self._thread.start()

    def close(self) -> None:
        """Stop answering; waits for the answer in progress."""
        self._closing.set()
        self._queryable.undeclare()
        self._thread.join()

    def _run(self) -> None:
        for query in receive_items(self._queryable.handler):
            with query:
                if self._closing.wait(self._bucket.take()):
                    return
                self._serve(query)

    def _serve(self, query: zenoh.Query) -> None:
        try:
            request = self._unpack(query)
        except InvalidMessageError as error:
            self._reject(query, Request(key=self._key, payload=b""), error)
            return
        try:
            answer = self._handle(request)
        except HalError as error:
            self._reject(query, request, error)
        except Exception as error:  # every type: the error of one request is not the end of its service
            _LOG.exception("%s: a request failed", self._key)
            self._reject(query, request, HalError(f"bus: {self._key} failed: {error}. See its log.", code="internal"))
        else:
            signed = sign_answer(self._secret, request, "answer", answer)
            self._send(lambda: query.reply(self._key, signed, express=True))

    def _unpack(self, query: zenoh.Query) -> Request:
        payload = as_bytes(query.payload)
        try:
            return Request.unpack(self._key, payload, as_bytes(query.attachment))
        except InvalidMessageError:
            if self._allow_anonymous:
                return Request(key=self._key, payload=payload)
            raise

    def _reject(self, query: zenoh.Query, request: Request, error: HalError) -> None:
        self._bucket.take(_REJECTED_COST)
        if isinstance(error, InvalidMessageError):
            self._rejections.warning("%s: rejected a malformed request: %s", self._key, error)
        signed = sign_answer(self._secret, request, "error", encode_error(error))
        self._send(lambda: query.reply_err(signed))

    def _send(self, reply: Callable[[], None]) -> None:
        try:
            reply()
        except zenoh.ZError as err:  # the client is gone, or the session is being closed
            _LOG.debug("%s: the answer was not sent: %s", self._key, err)


def as_bytes(payload: zenoh.ZBytes | bytes | None) -> bytes:
    """Return a payload or attachment as bytes; empty when there is none."""
    return payload.to_bytes() if isinstance(payload, zenoh.ZBytes) else payload or b""
