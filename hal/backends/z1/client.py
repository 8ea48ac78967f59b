"""Client of the vendor's controller: commands out, answers in, both paced and timed.

Nothing a peer sends raises an error here: invalid datagrams are counted and dropped, and a silent peer shows in the
age of the newest answer. Every command carries a posture that is harmless in any state of the controller, since a
request in LOWCMD is obeyed as a motor command first (measured).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hal.backends.z1.faults import FaultLatch
from hal.backends.z1.keeper.posture import compute_posture
from hal.backends.z1.pacing import MAX_LATENCY_S, CommandPacer
from hal.base.clock import Clock
from hal.base.errors import CommandRejectedError, HalTimeoutError
from hal.base.z1 import CONTROL_PERIOD_S, DQ_MAX
from hal.z1_protocol.controller import (
    KD_LOWCMD,
    WATCHDOG_S,
    CommandBuffer,
    ControllerState,
    decode_state,
)
from hal.z1_protocol.link import DatagramLink
from hal.z1_protocol.records import JointCommands, ProtocolError
from hal.z1_protocol.states import Fsm

ANSWER_MAX_AGE_S = 0.1
"""Maximum age of the newest answer [s]; the controller answers within 2 ms."""

# Ten periods without a look into the socket: its answers are outdated by then.
_PAUSE_S = 0.02
# Bounds one call of `receive`, so that a flood of datagrams cannot keep the servo from its next tick.
_MAX_DATAGRAMS = 1024
# An answer is an outlier when a joint moved by more than the first, plus the second times the time since the last one.
_JUMP_RAD = 0.1
_JUMP_SPEED = 3.0 * float(DQ_MAX.max())
# Answers sent before a request was granted still arrive after it: one alone is no state change.
_LEFT_COUNT = 3
_MAX_VISITED = 256
_MAX_REASON_CHARS = 200
_SETTLE_S = 0.1
_BLAME_S = 1.0  # a fall to PASSIVE so soon after a silence of this process is its consequence


@dataclass(slots=True, kw_only=True)
class DatagramCounts:
    """Datagrams since `open`, by outcome."""

    sent: int = 0
    """Commands sent."""
    unsent: int = 0
    """Commands that could not leave this machine."""
    skipped: int = 0
    """Commands that were replaced by a newer one before the controller had room for them."""
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
        self.publish: Callable[[bytes | bytearray], None] | None = None
        """Called with each command sent, for the process that keeps the controller supplied in our place."""
        self._reset()

    def _reset(self) -> None:
        self.counts = DatagramCounts()
        self.pacer = CommandPacer()
        self.faults = FaultLatch()
        self.carries_joints = False
        """Whether the body of `command` is seven joints' commands."""
        self.invalid_reason = ""
        """Reason for the last invalid datagram; empty without any."""
        self.expected: Fsm | None = None
        """State in which the controller was left; another one, unrequested, is a fault."""
        self.cancelled = False
        """Set by another thread, without the lock: every wait in here ends at once."""
        self._left_count = 0
        self.visited: deque[Fsm] = deque(maxlen=_MAX_VISITED)
        """States in the newest answers, since it was last cleared."""
        self._newest: ControllerState | None = None
        self.newest_s = self.changed_s = self.sent_s = -np.inf
        """Times of the newest answer, of the last change of a measurement, and of the last command sent [s]."""
        self._empty_s = self.polled_s = self._resumed_s = self._gap_end_s = -np.inf
        self._pause_s = self._gap_s = 0.0
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
            self.write_joints(self.posture(), track=False)
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

    def send(self, data: bytes | bytearray | None = None) -> bool:
        """Send `command`, or these bytes instead, unless two commands are unanswered; return whether it was sent.

        A command that must wait is not queued: the next call sends the newest one.
        """
        now_s = self.clock.now_s()
        if not self.pacer.may_send(now_s):
            self.counts.skipped += 1
            return False
        sent = self.command.data if data is None else data
        if self.link.send(sent):
            self.counts.sent += 1
        else:
            self.counts.unsent += 1
        self.pacer.record_command(now_s)
        if self.publish is not None:
            self.publish(sent if self.carries_joints else b"")
        if WATCHDOG_S < now_s - self.sent_s < np.inf:
            self._gap_s, self._gap_end_s = now_s - self.sent_s, now_s
        self.sent_s = now_s
        return True

    def receive(self, timeout_s: float = 0.0) -> bool:
        """Process all received datagrams, waiting up to `timeout_s` [s] for the first; return whether one was valid.

        After a pause of this process those in the socket are of any age, and are dropped.
        """
        now_s = self.clock.now_s()
        if now_s - self.polled_s > _PAUSE_S and self._newest is not None:
            self._pause_s, self._resumed_s = now_s - self.polled_s, now_s
            self._discard()
        answered = False
        for _ in range(_MAX_DATAGRAMS):
            data = self.link.receive(0.0 if answered else timeout_s)
            if data is None:
                self._empty_s = self.clock.now_s()
                break
            answered |= self._process(data)
        self.polled_s = self.clock.now_s()
        return answered

    def _discard(self) -> None:
        """Drop all received datagrams, and regard the commands before them as answered."""
        for _ in range(_MAX_DATAGRAMS):
            if self.link.receive() is None:
                break
        self.pacer.forget()

    def _process(self, data: memoryview) -> bool:
        now_s = self.clock.now_s()
        self.pacer.record_answer(now_s, self._empty_s)
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
        self.visited.append(state.state)
        self._check_state(state.state, now_s)
        if self.pacer.late_s:
            self.faults.add(
                f"commands reach the controller more than {1e3 * MAX_LATENCY_S:.0f} ms late: it is overloaded, or "
                f"another program sends to it",
                now_s,
            )
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
            self.faults.add(self.describe_departure(state), now_s)

    def describe_departure(self, state: Fsm) -> str:
        """Return how the controller came from the expected state to `state`, as far as it is known."""
        assert self.expected is not None
        change = f"the controller changed from {self.expected.name} to {state.name}"
        if state is Fsm.PASSIVE and self.newest_s - self._gap_end_s < _BLAME_S:
            return (
                f"{change}, where the arm sinks, because this process sent nothing for {self._gap_s:.1f} s (it allows "
                f"{WATCHDOG_S} s): it was stopped, or starved by other programs"
            )
        return f"{change} without a request of this driver"

    # --- Posture ----------------------------------------------------------------------------------------------------

    def posture(self) -> JointCommands:
        """Return the present posture as motor commands; see `hal.backends.z1.keeper.posture`."""
        joints = self.command.joints
        known = self.carries_joints
        return compute_posture(self.newest.joints, joints["q"] if known else None, joints["kp"] if known else None)

    def write_joints(self, commands: JointCommands, *, track: bool) -> None:
        """Write seven joints' commands into `command`, as a tracking target or not."""
        joints = self.command.joints
        for name in ("q", "dq", "tau", "kp", "kd"):
            joints[name] = getattr(commands, name)
        self.command.set_head(Fsm.INVALID, track=track)
        self.carries_joints = True

    # --- Waiting ----------------------------------------------------------------------------------------------------

    def settle(self) -> None:
        """Wait until no command is unanswered, so that the next answer belongs to the next command.

        Raises:
            CommandRejectedError: `cancelled` was set.
        """
        end_s = self.clock.now_s() + _SETTLE_S
        while self.pacer.unanswered and self.clock.now_s() < end_s:
            self._check_cancelled()
            self.receive(CONTROL_PERIOD_S)
        self.pacer.forget()

    def exchange_until(self, reached: Callable[[], bool], timeout_s: float, data: bytes | None = None) -> bool:
        """Exchange at the controller's rate until `reached`, or for `timeout_s` [s]; return whether it was reached.

        Raises:
            CommandRejectedError: `cancelled` was set.
        """
        end_s = self.clock.now_s() + timeout_s
        while self.clock.now_s() < end_s:
            self._check_cancelled()
            self.send(data)
            self.clock.sleep_until(self.clock.now_s() + CONTROL_PERIOD_S)
            self.receive()
            if reached():
                return True
        return False

    def _check_cancelled(self) -> None:
        if self.cancelled:
            raise CommandRejectedError("Z1: the request was interrupted by a stop.", code="cancelled")

    def check_age(self) -> None:
        """Check the age of the newest answer.

        Raises:
            HalTimeoutError: it is older than `ANSWER_MAX_AGE_S`.
        """
        now_s = self.clock.now_s()
        if now_s - self.newest_s <= ANSWER_MAX_AGE_S:
            return
        peer = self.link.describe()
        if self._resumed_s > self.newest_s:
            raise HalTimeoutError(
                f"Z1: the controller at {peer} has not answered for {now_s - self._resumed_s:.2f} s, after a pause of "
                f"{self._pause_s:.2f} s in this process (allowed {ANSWER_MAX_AGE_S} s). Inspect the arm: without "
                f"commands for {WATCHDOG_S} s it sinks. Then connect again.",
                code="stale_state",
            )
        raise HalTimeoutError(
            f"Z1: the controller at {peer} has not answered for {now_s - self.newest_s:.2f} s (allowed "
            f"{ANSWER_MAX_AGE_S} s). Restart `z1_ctrl` or its machine, then connect again.",
            code="stale_state",
        )
