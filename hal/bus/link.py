"""A client's end of the link: one session, and requests to the HAL that end in an answer or in a typed error."""

from __future__ import annotations

import itertools
import threading
from contextlib import suppress

import zenoh

from hal.base.clock import Clock
from hal.base.errors import HalError, HalTimeoutError, LeaseError, NotConnectedError
from hal.bus import keys
from hal.bus.authentication import NO_SECRET, LeaseGrant, Request, open_answer, verify_code
from hal.bus.codec import Hello, decode
from hal.bus.error_codec import decode_error
from hal.bus.frames import existing_segments, mapped_segments, unlink_segments
from hal.bus.runtime_files import read_secret
from hal.bus.service import as_bytes
from hal.bus.session import BusConfig, no_answer_error, open_session

_RETRY_S = 0.05
_ZENOH_TIMEOUT = b"Timeout"  # payload of the error reply with which Zenoh itself ends an unanswered query
_SAME_CLOCK_S = 0.05
"""Maximum clock offset taken as zero: on one machine both ends read the same clock, and an apparent offset is the
delay of the exchange itself."""


class BusLink:
    """An open connection to a HAL process, after the handshake.

    Args:
        config: address and timeouts.
        clock: this process's.
        device: name of the caller's device, for error texts.
        shared_memory: whether frames may come through shared memory.

    Raises:
        HalTimeoutError: no HAL process answers for this robot.
        HalError: the program that answers is not a HAL of this user (`unverified_hal`).
    """

    def __init__(self, config: BusConfig, clock: Clock, device: str, *, shared_memory: bool = False) -> None:
        self._config = config
        self._device = device
        self._clock = clock
        self._queriers: dict[str, tuple[zenoh.Querier, threading.Lock]] = {}
        self._lock = threading.Lock()  # two threads may make a request of one key at once
        self._counter = itertools.count(1)
        self._greeted = False
        before = existing_segments() if shared_memory else set()
        self.session = open_session(config, listen=False, shared_memory=shared_memory)
        # This session's own segments, which Zenoh would leave behind
        self._segments = mapped_segments() - before if shared_memory else set()
        try:
            self.secret = link_secret(config)
            self.hello, self.clock_offset_s = self._handshake()
            self._greeted = True
        except HalError:
            self.close()
            raise

    def request(self, key: str, payload: bytes = b"", name: str = "", grant: LeaseGrant | None = None) -> bytes:
        """Return the answer of the service at `key`.

        Args:
            key: the service.
            payload: of the request.
            name: of the client.
            grant: signs a command; None signs with the link's secret.

        Raises:
            HalTimeoutError: no answer (`no_answer`), or no HAL process (`no_hal`).
            HalError: the error of the service, with its class, code and text; or the HAL did not sign the answer
                (`unverified_hal`).
        """
        sent_s = self._clock.now_s()
        querier, in_order = self._querier(key)
        with in_order:  # the HAL accepts the counters of a key in increasing order only
            request = Request.make(grant.key if grant else self.secret, key, payload, name, next(self._counter))
            try:
                replies = querier.get(payload=payload, attachment=request.pack())
            except zenoh.ZError as err:
                raise NotConnectedError(self._device) from err
        unsigned = False
        for reply in replies:
            kind, data = ("answer", reply.ok.payload) if reply.ok else ("error", reply.err and reply.err.payload)
            if as_bytes(data) == _ZENOH_TIMEOUT:
                raise self._no_answer(key)
            body = open_answer(self.secret, request, kind, as_bytes(data))
            if body is None:
                unsigned = True
            elif kind == "error":
                raise decode_error(body)
            else:
                return body
        if unsigned:
            raise unverified_error(self._config, f"did not sign its answer to {key}")
        # No reply at once: no service exists. No reply after the timeout: the other end of Zenoh gave up first.
        if self._clock.now_s() - sent_s > 0.5 * self._config.request_timeout_s:
            raise self._no_answer(key)
        if self._config.keys and self._greeted and key in keys.COMMANDS:
            raise LeaseError(
                f"bus: no answer to {key}: the role of the certificate in {self._config.keys} does not allow it, or "
                f"the HAL has ended. Use an operator's keys.",
                code="no_permission",
            )
        raise no_answer_error(self._config)

    def is_signed(self, key: str, content: zenoh.ZBytes | bytes, code: zenoh.ZBytes | bytes | None) -> bool:
        """Return True when the HAL signed `content` of the topic `key` with `code`."""
        return verify_code(as_bytes(code), self.secret, key, as_bytes(content))

    def sign_heartbeat(self, grant: LeaseGrant) -> bytes:
        """Return the attachment of the next heartbeat of the lease's owner."""
        return Request.make(grant.key, keys.HEARTBEAT, b"", grant.owner, next(self._counter)).pack()

    def close(self) -> None:
        """End the session."""
        for querier, _ in self._queriers.values():  # an open one would keep a descriptor of the session
            with suppress(zenoh.ZError):
                querier.undeclare()
        self._queriers.clear()
        self.session.close()
        unlink_segments(self._segments)

    def _no_answer(self, key: str) -> HalTimeoutError:
        remedy = "Use the switch on the arm." if key == keys.STOP else "Check its log."
        return HalTimeoutError(
            f"bus: the HAL process at {self._config.endpoint} gave no answer to {key} within "
            f"{self._config.request_timeout_s} s. {remedy}",
            code="no_answer",
        )

    def _querier(self, key: str) -> tuple[zenoh.Querier, threading.Lock]:
        with self._lock:
            if key not in self._queriers:
                querier = self.session.declare_querier(
                    key,
                    target=zenoh.QueryTarget.ALL,  # not the nearest only: that may be another program's
                    timeout=self._config.request_timeout_s,
                    priority=zenoh.Priority.REAL_TIME,
                    congestion_control=zenoh.CongestionControl.BLOCK,  # a command must not be dropped
                    express=True,
                )
                self._queriers[key] = querier, threading.Lock()
            return self._queriers[key]

    def _handshake(self) -> tuple[Hello, float]:
        """Return the HAL's hello, and the offset of its clock from this one [s]."""
        give_up_s = self._clock.now_s() + self._config.connect_timeout_s
        pause = threading.Event()
        while True:
            sent_s = self._clock.now_s()
            try:
                hello = decode(self.request(keys.HELLO), Hello)
            except HalTimeoutError:
                # It listens before it serves, so a first request without answer may reach a starting HAL process.
                if self._clock.now_s() >= give_up_s:
                    raise
                pause.wait(_RETRY_S)
                continue
            offset_s = hello.now_s - 0.5 * (sent_s + self._clock.now_s())  # as if the HAL answered half-way
            return hello, 0.0 if abs(offset_s) < _SAME_CLOCK_S else offset_s


def link_secret(config: BusConfig) -> bytes:
    """Return the secret with which the HAL at `config` signs.

    Raises:
        HalError: this user runs no HAL there, but a program listens (`unverified_hal`).
    """
    if config.keys:
        return NO_SECRET
    secret = read_secret(config.port)
    if secret is None:
        raise unverified_error(config, "left no secret that this user can read")
    return secret


def unverified_error(config: BusConfig, failure: str) -> HalError:
    """Return the error for a program that cannot be distinguished from a stranger's."""
    return HalError(
        f"bus: the program at {config.endpoint} {failure}. Run client and HAL as the same user, or both with `--keys`; "
        f"if the HAL has ended, another program has taken its port.",
        code="unverified_hal",
    )
