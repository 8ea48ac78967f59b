"""A client's end of the link: one session, and questions to the HAL that end in an answer or in a typed error."""

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
_SAME_CLOCK_S = 0.05
"""Both ends on one machine read the same clock; what the exchange of stamps seems to differ by is its own delay."""


class BusLink:
    """An open connection to a HAL process that has said hello.

    Args:
        config: where it is.
        clock: this process's.
        device: what the caller is, for the text of errors.

    Raises:
        HalTimeoutError: no HAL process answers for this robot.
    """

    def __init__(self, config: BusConfig, clock: Clock, device: str) -> None:
        self._config = config
        self._device = device
        self._clock = clock
        self._queriers: dict[str, zenoh.Querier] = {}
        self._lock = threading.Lock()
        before = existing_segments()
        self.session = open_session(config, listen=False)
        self._segments = mapped_segments() - before
        try:
            self.hello, self.clock_offset_s = self._handshake()
        except HalError:
            self.close()
            raise

    def ask(self, key: str, payload: bytes = b"", owner: str = "") -> bytes:
        """Return the answer of the service at `key`.

        Raises:
            HalTimeoutError: no answer.
            HalError: whatever the service raised, as the same class.
        """
        asked_s = self._clock.now_s()
        try:
            replies = list(self._querier(key).get(payload=payload, attachment=owner.encode()))
        except zenoh.ZError as err:
            raise NotConnectedError(self._device) from err
        for reply in replies:
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            text = as_bytes(reply.err.payload) if reply.err is not None else b""
            if text == b"Timeout":  # Zenoh's own
                raise self._no_answer(key)
            raise decode_error(text)
        # Nothing at once: nobody was asked. Nothing after the timeout: the other end of Zenoh gave up before this one.
        if self._clock.now_s() - asked_s > 0.5 * self._config.request_timeout_s:
            raise self._no_answer(key)
        raise no_answer_error(self._config)

    def close(self) -> None:
        """End the session."""
        self.session.close()
        unlink_segments(self._segments)

    def _no_answer(self, key: str) -> HalTimeoutError:
        return HalTimeoutError(
            f"{key}: the HAL process at {self._config.endpoint} gave no answer within "
            f"{self._config.request_timeout_s} s; look at its log."
        )

    def _querier(self, key: str) -> zenoh.Querier:
        with self._lock:
            if key not in self._queriers:
                self._queriers[key] = self.session.declare_querier(
                    key,
                    timeout=self._config.request_timeout_s,
                    priority=zenoh.Priority.REAL_TIME,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                    express=True,
                )
            return self._queriers[key]

    def _handshake(self) -> tuple[Hello, float]:
        """Return the HAL's hello, and its clock minus ours [s]."""
        give_up_s = self._clock.now_s() + self._config.connect_timeout_s
        pause = threading.Event()
        while True:
            asked_s = self._clock.now_s()
            try:
                hello = decode(self.ask(keys.HELLO), Hello)
            except HalTimeoutError:
                # It listens before it serves, so a first silence may be a HAL process that is just starting.
                if self._clock.now_s() >= give_up_s:
                    raise
                pause.wait(_RETRY_S)
                continue
            offset_s = hello.now_s - 0.5 * (asked_s + self._clock.now_s())
            return hello, 0.0 if abs(offset_s) < _SAME_CLOCK_S else offset_s
