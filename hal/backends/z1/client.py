"""Client of the vendor's controller: commands out, answers in, state requests.

Nothing a peer sends raises an error here: invalid datagrams are counted and dropped, and a silent peer shows in the
age of the newest answer.
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
from hal.z1_protocol.states import Fsm, is_granted

ANSWER_MAX_AGE_S = 0.1
"""Maximum age of the newest answer [s]; the controller answers within 2 ms."""

_REMEDIES = {
    Fsm.LOWCMD: "LOWCMD is entered from PASSIVE only.",
    Fsm.PASSIVE: "Wait for the end of its present motion.",
}
_DEFAULT_REMEDY = "Bring it to JOINTCTRL first."
# Bounds one call of `receive`, so that a flood of datagrams cannot keep the servo from its next tick.
_MAX_DATAGRAMS = 1024
# An answer is an outlier when a joint moved by more than the first, plus the second times the time since the last one.
_JUMP_RAD = 0.1
_JUMP_SPEED = 3.0 * float(DQ_MAX.max())
# Answers sent before a request was granted still arrive after it: one alone is no state change.
_LEFT_COUNT = 3
_MAX_REASON_CHARS = 200


@dataclass(slots=True, kw_only=True)
class DatagramCounts:
    """Datagrams since `open`, by outcome."""

    sent: int = 0
    """Commands sent."""
    unsent: int = 0
    """Commands that could not leave this machine."""
    answers: int = 0
    """Valid answers."""
    repeats: int = 0
    """Of these, exact repetitions of the one before (half of them on a real arm: its board runs at 250 Hz)."""
    invalid: int = 0
    """Datagrams with a wrong size, head or value."""
    jumps: int = 0
    """Answers dropped because a joint cannot have moved so far so fast."""


class Z1Client:
    """Client of one controller; it has no lock of its own: its owner admits one thread at a time.

    Args:
        link: datagram link to the controller.
        clock: source of time.
    """

    def __init__(self, link: DatagramLink, clock: Clock) -> None:
        self.link = link
        self.clock = clock
        self.command = CommandBuffer()
        """The command that `send` sends."""
        self._reset()

    def _reset(self) -> None:
        self.counts = DatagramCounts()
        self.faults = FaultLatch()
        self.invalid_reason = ""
        """Reason for the last invalid datagram; empty without any."""
        self.expected: Fsm | None = None
        """State in which the controller was left; another one, unrequested, is a fault."""
        self.cancelled = False
        """Set by another thread, without the lock: every wait in here ends at once."""
        self._left_count = 0
        self._visited: set[Fsm] = set()  # a motion that is not possible shows its state for one cycle only (measured)
        self._newest: ControllerState | None = None
        self.newest_s = self.changed_s = self.sent_s = -np.inf
        """Times of the newest answer, of the last change of a measurement, and of the last command sent [s]."""
        self._raw = b""
        self._outlier: np.ndarray | None = None

    # --- Connection -----------------------------------------------------------------------------------------------

    def open(self, timeout_s: float) -> None:
        """Open the link and wait for an answer; the command sent requests no state change.

        Raises:
            HalTimeoutError: no answer within `timeout_s` [s]; the link is closed again.
            HalError: the link cannot be opened.
        """
        self._reset()
        self.link.open()
        # A controller that a crashed client left in LOWCMD executes every datagram: this one brakes.
        self.command.set_head(Fsm.INVALID, track=False)
        self.command.joints[:] = 0
        self.command.joints["kd"] = KD_LOWCMD
        if self.exchange_until(lambda: self._newest is not None, timeout_s):
            return
        peer = self.link.describe()
        self.link.close()
        received = f"{self.counts.invalid} invalid datagrams received, the last one: {self.invalid_reason}"
        raise HalTimeoutError(
            f"Z1: no controller answers at {peer} within {timeout_s} s; "
            f"{received if self.counts.invalid else 'nothing was received'}. Switch the arm on, check its cable, and "
            f"start the vendor's `z1_ctrl` on that machine, or the twin with `./z1 twin wire`.",
            code="no_controller",
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
        """Whether the last three answers report another state than the expected one."""
        return self._left_count >= _LEFT_COUNT

    def send(self, data: bytes | bytearray | None = None) -> None:
        """Send `command`, or these bytes instead."""
        if self.link.send(self.command.data if data is None else data):
            self.counts.sent += 1
        else:
            self.counts.unsent += 1
        self.sent_s = self.clock.now_s()

    def receive(self, timeout_s: float = 0.0) -> bool:
        """Process all received datagrams, waiting up to `timeout_s` [s] for the first; return whether one was valid."""
        answered = False
        for _ in range(_MAX_DATAGRAMS):
            data = self.link.receive(0.0 if answered else timeout_s)
            if data is None:
                break
            answered |= self._process(data)
        return answered

    def discard(self) -> None:
        """Discard all received datagrams."""
        for _ in range(_MAX_DATAGRAMS):
            if self.link.receive() is None:
                break

    def _process(self, data: memoryview) -> bool:
        now_s = self.clock.now_s()
        state = self._newest
        if state is not None and data == self._raw:
            self.counts.repeats += 1
        else:
            try:
                state = decode_state(data)
            except ProtocolError as error:
                self.counts.invalid += 1
                self.invalid_reason = str(error)[:_MAX_REASON_CHARS]
                return False
            if self._is_outlier(state.joints.q, now_s):
                self.counts.jumps += 1
                return False
            self.changed_s = now_s
            self._newest, self._raw = state, bytes(data)
        self.newest_s = now_s
        self.counts.answers += 1
        self.faults.update(state.joints, now_s)
        self._visited.add(state.state)
        self._check_state(state.state, now_s)
        return True

    def _is_outlier(self, q: np.ndarray, now_s: float) -> bool:
        """Return whether a joint cannot have moved there; a second answer that confirms it is accepted."""
        if self._newest is None:
            return False
        reach = _JUMP_RAD + _JUMP_SPEED * (now_s - self.newest_s)
        if (np.abs(q - self._newest.joints.q) <= reach).all():
            self._outlier = None
            return False
        if self._outlier is not None and (np.abs(q - self._outlier) <= reach).all():
            self._outlier = None
            return False
        self._outlier = q
        return True

    def _check_state(self, state: Fsm, now_s: float) -> None:
        if self.expected is None or state is self.expected:
            self._left_count = 0
            return
        self._left_count += 1
        if self.has_left:
            self.faults.add(
                f"the controller changed from {self.expected.name} to {state.name} without a request", now_s
            )

    # --- Requests -------------------------------------------------------------------------------------------------

    def request_state(
        self, requested: Fsm, body: JointCommands | TrajectoryCommand | str | None = None, *, timeout_s: float = 0.3
    ) -> None:
        """Request a state until the controller is in it; from then on request no change, with the same body.

        Raises:
            CommandRejectedError: the controller ignores the request, or the transition is not allowed.
            HalTimeoutError: it stopped answering.
        """
        present = self.newest.state
        self.expected = None
        if not is_granted(present, requested):
            raise CommandRejectedError(
                f"Z1: the controller does not change from {present.name} to {requested.name}. "
                f"{_REMEDIES.get(requested, _DEFAULT_REMEDY)}",
                code="transition_not_allowed",
            )
        request = encode_command(requested, body)
        self._visited.clear()
        if not self.exchange_until(lambda: requested in self._visited, timeout_s, request):
            self.check_age()
            raise CommandRejectedError(
                f"Z1: the controller stays in {self.newest.state.name} after {timeout_s} s of requests for "
                f"{requested.name}: the request is not possible (unknown label, pose out of reach) or already done.",
                code="request_ignored",
            )
        self.command.data[:] = encode_command(Fsm.INVALID, body)

    def wait_for_state(self, state: Fsm, timeout_s: float) -> None:
        """Exchange datagrams until the controller is in `state`.

        Raises:
            HalTimeoutError: it is not after `timeout_s` [s], or it stopped answering.
        """
        if not self.exchange_until(lambda: self.newest.state is state, timeout_s):
            self.check_age()
            raise HalTimeoutError(
                f"Z1: the controller is in {self.newest.state.name} after {timeout_s} s; expected is {state.name}.",
                code="state_timeout",
            )

    def exchange_until(self, reached: Callable[[], bool], timeout_s: float, data: bytes | None = None) -> bool:
        """Exchange at the control rate until `reached`, or for `timeout_s` [s]; return whether it was reached.

        Raises:
            CommandRejectedError: `cancelled` was set.
        """
        end_s = self.clock.now_s() + timeout_s
        while self.clock.now_s() < end_s:
            if self.cancelled:
                raise CommandRejectedError("Z1: the request was interrupted by a stop.", code="cancelled")
            self.send(data)
            # The controller reads one datagram a cycle of about 2 ms: faster ones queue up, and are obeyed ever later
            # (measured).
            self.clock.sleep_until(self.sent_s + CONTROL_PERIOD_S)
            self.receive()
            if reached():
                return True
        return False

    def check_age(self) -> None:
        """Check the age of the newest answer.

        Raises:
            HalTimeoutError: it is older than `ANSWER_MAX_AGE_S`.
        """
        age_s = self.clock.now_s() - self.newest_s
        if age_s > ANSWER_MAX_AGE_S:
            raise HalTimeoutError(
                f"Z1: the controller at {self.link.describe()} has not answered for {age_s:.2f} s (allowed "
                f"{ANSWER_MAX_AGE_S} s). Restart `z1_ctrl` or its machine, then connect again.",
                code="stale_state",
            )
