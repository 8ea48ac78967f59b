"""Socket of the vendor's controller at its client's side: each cycle sends one answer and reads one datagram."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from hal.z1_protocol.controller import BODY_SIZE, Command, decode_command
from hal.z1_protocol.records import ProtocolError
from hal.z1_protocol.states import Fsm

CYCLE_S = 0.002035
"""Shortest period of the controller's thread that talks to the client [s] (measured: 491 cycles a second)."""
QUEUE_LENGTH = 202
"""Datagrams that the kernel keeps for the controller; later ones are lost (measured: a backlog of 0.41 s at most)."""
RECEIVE_TIMEOUT_S = 0.101
"""Wait for a datagram in each cycle [s]; without a client the answers come at this period (measured)."""
WATCHDOG_TIMEOUTS = 21
"""Cycles without a datagram until PASSIVE is requested; the next answer shows it, after 2.2 s (measured)."""


class ClientPort:
    """Queue of received datagrams, first in first out, and the command that the state machine finds in it.

    The newest command read remains valid, with its requested state, until the next one; any datagram, invalid ones
    included, restarts the watchdog (measured).
    """

    def __init__(self) -> None:
        self.command = Command(state=Fsm.INVALID, track=False, body=bytes(BODY_SIZE))
        """The command read last; PASSIVE after the watchdog's timeout."""
        self.connected = False
        """Whether a command was read."""
        self.dropped = 0
        """Datagrams lost because the queue was full."""
        self.invalid_datagrams = 0
        """Datagrams that were no commands."""
        self.invalid_reason = ""
        """Reason for the last one."""
        self._queue: deque[bytes] = deque()
        self._waiting = False
        self._start_s = self._next_s = 0.0  # of the present cycle, and of the next one
        self._timeouts = 0

    @property
    def backlog(self) -> int:
        """Datagrams received and not yet read."""
        return len(self._queue)

    def receive(self, data: bytes | memoryview) -> None:
        """Queue a datagram."""
        if len(self._queue) >= QUEUE_LENGTH:
            self.dropped += 1
        else:
            self._queue.append(bytes(data))

    def advance(self, now_s: float) -> bool:
        """Advance to `now_s` [s]; return whether an answer is due."""
        answers = False
        while True:
            if self._waiting and not self._read(now_s):
                return answers
            if now_s < self._next_s:
                return answers
            self._start_s, self._waiting, answers = self._next_s, True, True

    def _read(self, now_s: float) -> bool:
        """Read a datagram, or give up after the timeout; return whether the cycle's wait is over."""
        if self._queue:
            self._timeouts = 0
            self._decode(self._queue.popleft())
        elif now_s - self._start_s < RECEIVE_TIMEOUT_S:
            return False
        else:
            self._timeouts += 1
            if self._timeouts >= WATCHDOG_TIMEOUTS:
                self.command = replace(self.command, state=Fsm.PASSIVE)
        self._waiting, self._next_s = False, max(self._start_s + CYCLE_S, now_s)
        return True

    def _decode(self, data: bytes) -> None:
        try:
            self.command = decode_command(data)
            self.connected = True
        except ProtocolError as error:
            self.invalid_datagrams += 1
            self.invalid_reason = str(error)
