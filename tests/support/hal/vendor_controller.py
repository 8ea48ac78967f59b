"""Double of the vendor's controller as it was measured: one datagram a cycle, a queue, a watchdog, one-cycle states.

It runs on a clock of its own that `VendorLink` steps to the test's, cycle by cycle; its physics are `FakeController`'s.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from hal.base import z1
from hal.base.clock import Clock, ManualClock
from hal.z1_protocol.controller import LABELS, Command, decode_command
from hal.z1_protocol.records import ProtocolError
from hal.z1_protocol.states import MOVES, Fsm, is_granted
from tests.support.hal.z1_peer import FakeController

CYCLE_S = 0.00203
"""Period at which it reads one datagram (measured)."""
WATCHDOG_S = 2.2
"""Silence of the client after which it falls to PASSIVE (measured)."""
_SILENT_ANSWER_S = 0.1
_QUEUE_SIZE = 200
_ACTIVE = frozenset(Fsm) - {Fsm.PASSIVE, Fsm.INVALID}


class VendorController(FakeController):
    """The controller; `VendorLink` calls `deliver` and `advance`."""

    def __init__(self, start_s: float, q: np.ndarray | None = None) -> None:
        self.own_clock = ManualClock(start_s)
        super().__init__(self.own_clock, q)
        self.queue: deque[tuple[int, bytes]] = deque()
        self.outbox: deque[tuple[float, bytes]] = deque()
        self.delivered = 0
        self.read: list[tuple[float, int]] = []
        """Time and number of each datagram read."""
        self.blocked_until_s = -np.inf
        """It neither reads nor answers until then, as while it plans a path."""
        self.dropped = 0
        self.answered_elsewhere: set[int] = set()
        """Numbers of the datagrams of another client, which gets the answers."""
        self._read_s = self._answered_s = start_s
        self._one_cycle: Fsm | None = None

    def deliver(self, data: bytes) -> None:
        """Put a datagram into its socket, which drops it when it is full."""
        self.delivered += 1
        if len(self.queue) < _QUEUE_SIZE:
            self.queue.append((self.delivered, data))
        else:
            self.dropped += 1

    def advance(self, now_s: float) -> None:
        """Run all cycles up to `now_s` [s]."""
        while self.own_clock.now_s() + CYCLE_S <= now_s:
            self.own_clock.advance(CYCLE_S)
            self.move()
            if self.own_clock.now_s() >= self.blocked_until_s:
                self._cycle(self.own_clock.now_s())

    def _cycle(self, now_s: float) -> None:
        if self._one_cycle is not None:  # shown in exactly one answer
            self.fsm, self._one_cycle = Fsm.JOINTCTRL, None
        if self.queue:
            number, data = self.queue.popleft()
            self._read_s = now_s
            self.read.append((now_s, number))
            elsewhere = number in self.answered_elsewhere
            try:
                command = decode_command(data)
                self.received.append(command)
                self._execute(command)
            except ProtocolError:
                self.invalid_datagrams += 1
        else:
            elsewhere = False
            if now_s - self._read_s > WATCHDOG_S and self.fsm in _ACTIVE:
                self.fsm = Fsm.PASSIVE
            if now_s - self._answered_s < _SILENT_ANSWER_S:
                return
        self._answered_s = now_s
        if not (self.mute or elsewhere):
            self.outbox.append((now_s, self.answer()))

    def _step(self, dt_s: float) -> None:
        super()._step(dt_s)
        if self.fsm not in (Fsm.PASSIVE, Fsm.LOWCMD):  # the torque with which the jaw is pressed on an object
            self.tau = np.append(self.tau[: z1.N_ARM], z1.KP[z1.N_ARM] * (self.target - self.q)[z1.N_ARM])

    def _execute(self, command: Command) -> None:
        state = command.state
        if state in self.ignored_requests or (state is not Fsm.INVALID and not is_granted(self.fsm, state)):
            state = Fsm.INVALID
        elif state not in (Fsm.INVALID, self.fsm):
            if self.fsm is Fsm.LOWCMD:
                self._leave_low_level(command)
                return
            if state in MOVES and (state is Fsm.SAVESTATE or not self._set_goal(command)):
                self.fsm, self._one_cycle, self.target = state, state, self.q.copy()
                return
        super()._execute(command)

    def _leave_low_level(self, command: Command) -> None:
        """Obey the request's body as a motor command for one cycle, and start from its position (measured)."""
        self.commands = command.joints()
        for _ in range(2):
            self._step(CYCLE_S / 2)
        self.fsm, self.target, self.tracking = command.state, self.commands.q.copy(), False
        if command.state is Fsm.BACKTOSTART:
            self._goal = np.append(LABELS["startFlat"], z1.GRIPPER_CLOSED)


class VendorLink:
    """Datagram link to a `VendorController` on a test's clock, which its waits advance."""

    def __init__(self, peer: VendorController, clock: Clock, latency_s: float = 1e-4) -> None:
        self.peer, self.clock, self.latency_s = peer, clock, latency_s
        self.lost: set[int] = set()
        """Numbers of the sent datagrams that are lost."""
        self.sent = 0
        self.is_open = False

    def open(self) -> None:
        self.is_open = True

    def close(self) -> None:
        self.is_open = False

    def fileno(self) -> int | None:
        return None

    def send(self, data: bytes | bytearray) -> bool:
        self.peer.advance(self.clock.now_s())
        self.sent += 1
        if self.sent not in self.lost:
            self.peer.deliver(bytes(data))
        return True

    def receive(self, timeout_s: float = 0.0) -> memoryview | None:
        end_s = self.clock.now_s() + timeout_s
        while True:
            self.peer.advance(self.clock.now_s())
            if self.peer.outbox and self.peer.outbox[0][0] + self.latency_s <= self.clock.now_s():
                return memoryview(self.peer.outbox.popleft()[1])
            if self.clock.now_s() >= end_s:
                return None
            self.clock.sleep_until(min(self.clock.now_s() + 2e-4, end_s))

    def describe(self) -> str:
        return "the vendor's double"
