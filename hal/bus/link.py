"""A client's end of the link: one session, and requests to the HAL that end in an answer or in a typed error."""

from __future__ import annotations

import threading

import zenoh

from hal.base.clock import Clock
from hal.base.errors import HalError, HalTimeoutError, NotConnectedError
from hal.bus import keys
from hal.bus.codec import Hello, decode
from hal.bus.error_codec import decode_error
from hal.bus.frames import existing_segments, mapped_segments, unlink_segments
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

    Raises:
        HalTimeoutError: no HAL process answers for this robot.
    """

    def __init__(self, config: BusConfig, clock: Clock, device: str) -> None:
        self._config = config
        self._device = device
        self._clock = clock
        self._queriers: dict[str, zenoh.Querier] = {}
        self._lock = threading.Lock()  # two threads may make the first request of one key at once
        before = existing_segments()
        self.session = open_session(config, listen=False)
        self._segments = mapped_segments() - before  # this session's own, which Zenoh would leave behind
        try:
            self.hello, self.clock_offset_s = self._handshake()
        except HalError:
            self.close()
            raise

    def request(self, key: str, payload: bytes = b"", owner: str = "") -> bytes:
        """Return the answer of the service at `key`.

        Raises:
            HalTimeoutError: no answer (`no_answer`), or no HAL process (`no_hal`).
            HalError: the error of the service, with its class, code and text.
        """
        sent_s = self._clock.now_s()
        try:
            replies = list(self._querier(key).get(payload=payload, attachment=owner.encode()))
        except zenoh.ZError as err:
            raise NotConnectedError(self._device) from err
        for reply in replies:
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            text = as_bytes(reply.err.payload) if reply.err is not None else b""
            if text == _ZENOH_TIMEOUT:
                raise self._no_answer(key)
            raise decode_error(text)
        # No reply at once: no service exists. No reply after the timeout: the other end of Zenoh gave up first.
        if self._clock.now_s() - sent_s > 0.5 * self._config.request_timeout_s:
            raise self._no_answer(key)
        raise no_answer_error(self._config)

    def close(self) -> None:
        """End the session."""
        self.session.close()
        unlink_segments(self._segments)

    def _no_answer(self, key: str) -> HalTimeoutError:
        return HalTimeoutError(
            f"bus: the HAL process at {self._config.endpoint} gave no answer to {key} within "
            f"{self._config.request_timeout_s} s. Check its log.",
            code="no_answer",
        )

    def _querier(self, key: str) -> zenoh.Querier:
        with self._lock:
            if key not in self._queriers:
                self._queriers[key] = self.session.declare_querier(
                    key,
                    timeout=self._config.request_timeout_s,
                    priority=zenoh.Priority.REAL_TIME,
                    congestion_control=zenoh.CongestionControl.BLOCK,  # a command must not be dropped
                    express=True,
                )
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
