"""The conversation with the vendor's controller: one command out, whatever came in, and requests for states.

Nothing a peer sends raises an error here: what is wrong is counted and dropped, and its silence shows in the age of
the newest answer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hal.backends.z1.faults import FaultLatch
from hal.base.clock import Clock
from hal.base.errors import CommandRejectedError, HalTimeoutError
from hal.base.z1 import CONTROL_PERIOD_S, DQ_MAX
from hal.z1_protocol.controller import (
    KD_LOWCMD,
    CommandBuffer,
    ControllerState,
    TrajectoryCommand,
    decode_state,
    encode_command,
)
from hal.z1_protocol.link import DatagramLink
from hal.z1_protocol.records import JointCommands, ProtocolError
from hal.z1_protocol.states import Fsm, granted

ANSWER_MAX_AGE_S = 0.1
"""The newest answer must not be older [s]; the controller answers within 2 ms."""

_WAYS = {
    Fsm.LOWCMD: "LOWCMD is entered from PASSIVE only.",
    Fsm.PASSIVE: "Wait until it has done what it does.",
}
_WAY = "Bring it to JOINTCTRL first."
_MOST_AT_ONCE = 1024
_JUMP_RAD = 0.1
_JUMP_SPEED = 3.0 * float(DQ_MAX.max())
_LEFT_TIMES = 3
_LAST_REFUSAL_CHARS = 200


@dataclass(slots=True, kw_only=True)
class Counts:
    """What became of the datagrams since `open`."""

    sent: int = 0
    """Commands sent."""
    unsent: int = 0
    """Commands that could not leave this machine."""
    answers: int = 0
    """Answers that were used."""
    repeats: int = 0
    """Of these, exact repetitions of the one before (half of them on a real arm: its board runs at 250 Hz)."""
    refused: int = 0
    """Datagrams that were no answers: wrong size, head or values."""
    jumps: int = 0
    """Answers dropped because a joint cannot have moved so far so fast."""


class Z1Client:
    """One client of one controller; the caller sees to it that one thread at a time is inside.

    Args:
        link: the way to the controller.
        clock: what time it is.
    """

    def __init__(self, link: DatagramLink, clock: Clock) -> None:
        self.link = link
        self.clock = clock
        self.command = CommandBuffer()
        """What `send` sends."""
        self._reset()

    def _reset(self) -> None:
        self.counts = Counts()
        self.faults = FaultLatch()
        self.last_refusal = ""
        """Why a datagram was refused last; empty when none was."""
        self.expected: Fsm | None = None
        """The state the controller is left alone in; another one, unasked, is a fault."""
        self.cancelled = False
        """Set by another thread: whoever waits for something here gives up at once."""
        self._left_times = 0
        self._been: set[Fsm] = set()
        self._newest: ControllerState | None = None
        self.newest_s = self.changed_s = self.sent_s = -np.inf
        """When the newest answer came, when a measurement last changed, when the last command left [s]."""
        self._raw = b""
        self._candidate: np.ndarray | None = None

    # --- Life ---------------------------------------------------------------------------------------------------

    def open(self, timeout_s: float) -> None:
        """Open the link and wait for an answer; the question changes no state.

        Raises:
            HalTimeoutError: nobody answers in `timeout_s` [s]; the link is closed again.
            HalError: the link cannot be opened.
        """
        self._reset()
        self.link.open()
        # A controller that a dead client left in LOWCMD obeys every datagram: this one brakes until more is known.
        self.command.head(Fsm.INVALID, track=False)
        self.command.joints[:] = 0
        self.command.joints["kd"] = KD_LOWCMD
        if self.exchange_until(lambda: self._newest is not None, timeout_s):
            return
        tried = self.link.describe()
        self.link.close()
        heard = f"{self.counts.refused} datagrams came that are no answers, the last one because {self.last_refusal}"
        raise HalTimeoutError(
            f"no Z1 controller answers at {tried}; waited {timeout_s} s, "
            f"{heard if self.counts.refused else 'nothing came'}. Switch the arm on, check its cable, and start the "
            f"vendor's `z1_ctrl` on that machine, or the twin with `./z1 twin wire`."
        )

    def close(self) -> None:
        """Close the link. Harmless when not open."""
        self.link.close()
        self._newest = None

    # --- One exchange ---------------------------------------------------------------------------------------------

    @property
    def newest(self) -> ControllerState:
        """The newest answer; there is one from `open` to `close`."""
        assert self._newest is not None
        return self._newest

    @property
    def has_left(self) -> bool:
        """Whether the last three answers say that the controller is not in the expected state."""
        return self._left_times >= _LEFT_TIMES

    def send(self, data: bytes | bytearray | None = None) -> None:
        """Send `command`, or these bytes instead."""
        if self.link.send(self.command.data if data is None else data):
            self.counts.sent += 1
        else:
            self.counts.unsent += 1
        self.sent_s = self.clock.now_s()

    def receive(self, timeout_s: float = 0.0) -> bool:
        """Take all that came, waiting up to `timeout_s` [s] if nothing did; say whether there was an answer."""
        answered = False
        for _ in range(_MOST_AT_ONCE):
            data = self.link.receive(0.0 if answered else timeout_s)
            if data is None:
                break
            answered |= self._take(data)
        return answered

    def discard(self) -> None:
        """Throw away all that came."""
        for _ in range(_MOST_AT_ONCE):
            if self.link.receive() is None:
                break

    def _take(self, data: memoryview) -> bool:
        now_s = self.clock.now_s()
        state = self._newest
        if state is not None and data == self._raw:
            self.counts.repeats += 1
        else:
            try:
                state = decode_state(data)
            except ProtocolError as error:
                self.counts.refused += 1
                self.last_refusal = str(error)[:_LAST_REFUSAL_CHARS]
                return False
            if self._jumped(state.joints.q, now_s):
                self.counts.jumps += 1
                return False
            self.changed_s = now_s
            self._newest, self._raw = state, bytes(data)
        self.newest_s = now_s
        self.counts.answers += 1
        self.faults.update(state.joints, now_s)
        self._been.add(state.state)
        self._watch(state.state, now_s)
        return True

    def _jumped(self, q: np.ndarray, now_s: float) -> bool:
        """Whether a joint is where it cannot be; the second answer that says so is believed."""
        if self._newest is None:
            return False
        reach = _JUMP_RAD + _JUMP_SPEED * (now_s - self.newest_s)
        if (np.abs(q - self._newest.joints.q) <= reach).all():
            self._candidate = None
            return False
        if self._candidate is not None and (np.abs(q - self._candidate) <= reach).all():
            self._candidate = None
            return False
        self._candidate = q
        return True

    def _watch(self, state: Fsm, now_s: float) -> None:
        if self.expected is None or state is self.expected:
            self._left_times = 0
            return
        self._left_times += 1
        if self.has_left:
            self.faults.note(f"the controller went from {self.expected.name} to {state.name} unasked", now_s)

    # --- Requests ----------------------------------------------------------------------------------------------------

    def ask(
        self, asked: Fsm, body: JointCommands | TrajectoryCommand | str | None = None, *, timeout_s: float = 0.3
    ) -> None:
        """Ask for a state until the controller is in it; then keep asking for nothing, with the same body.

        Raises:
            CommandRejectedError: it does not go there, or not from where it is.
            HalTimeoutError: it stopped answering.
        """
        was = self.newest.state
        self.expected = None
        if not granted(was, asked):
            raise CommandRejectedError(
                f"the controller is in {was.name}, from where it does not go to {asked.name}. {_WAYS.get(asked, _WAY)}"
            )
        request = encode_command(asked, body)
        self._been.clear()
        if not self.exchange_until(lambda: asked in self._been, timeout_s, request):
            self.check_answers()
            raise CommandRejectedError(
                f"the controller stays in {self.newest.state.name} when asked for {asked.name} for {timeout_s} s: it "
                f"cannot do that (an unknown label, a pose out of reach), or it is there already."
            )
        self.command.data[:] = encode_command(Fsm.INVALID, body)

    def wait_for(self, state: Fsm, timeout_s: float) -> None:
        """Go on exchanging until the controller is in `state`.

        Raises:
            HalTimeoutError: it is not after `timeout_s` [s], or stopped answering.
        """
        if not self.exchange_until(lambda: self.newest.state is state, timeout_s):
            self.check_answers()
            raise HalTimeoutError(
                f"the controller is in {self.newest.state.name} after {timeout_s} s; expected was {state.name}."
            )

    def exchange_until(self, reached: Callable[[], bool], timeout_s: float, data: bytes | None = None) -> bool:
        """Exchange at the control rate until `reached`, or for `timeout_s` [s]; say whether it was.

        Raises:
            CommandRejectedError: somebody set `cancelled`.
        """
        end_s = self.clock.now_s() + timeout_s
        while self.clock.now_s() < end_s:
            if self.cancelled:
                raise CommandRejectedError("a stop came in between.")
            self.send(data)
            self.clock.sleep_until(self.sent_s + CONTROL_PERIOD_S)
            self.receive()
            if reached():
                return True
        return False

    def check_answers(self) -> None:
        """Raise when the newest answer is too old.

        Raises:
            HalTimeoutError: it is.
        """
        age_s = self.clock.now_s() - self.newest_s
        if age_s > ANSWER_MAX_AGE_S:
            raise HalTimeoutError(
                f"the controller at {self.link.describe()} has not answered for {age_s:.2f} s; allowed is "
                f"{ANSWER_MAX_AGE_S} s. Its program or its machine is gone: start it again, then connect again."
            )
