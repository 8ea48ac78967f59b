"""Requests to the controller, each with an identity: asked, seen, done or refused.

Answers have no number, but come in the order of the commands, one for each: a request is seen when its own answer has
come. Only a request that was seen can be refused; one that is late is awaited, and retracted when it is given up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from hal.backends.z1.client import Z1Client
from hal.base import z1
from hal.base.errors import CommandRejectedError, HalError, HalTimeoutError
from hal.z1_protocol.controller import TrajectoryCommand, encode_command
from hal.z1_protocol.records import JointCommands
from hal.z1_protocol.states import MOVES, Fsm, is_granted

_REMEDIES = {
    Fsm.LOWCMD: "LOWCMD is entered from PASSIVE only.",
    Fsm.PASSIVE: "Wait for the end of its present motion.",
}
_DEFAULT_REMEDY = "Bring it to JOINTCTRL first."
_TRIES = 3  # in case a request or its answer is lost
# The controller may be busy, as while it plans a path (0.3 s): a request in its socket is late, not refused.
_UNREAD_S = 2.0
_MIN_ANSWERS = 10  # after the request's own, before it counts as refused
# The controller's states change every 4 ms, by the newest command at that time: three, 2 ms apart, cannot be missed.
_REPEATS = 3
# A motion that is not possible shows for one cycle (measured), one that is for 0.17 s and more.
_STARTED = 20
_ENDED = 10
_MOVING_RAD_S = 0.05
_CALIBRATED_RAD = 0.05


class RequestPhase(StrEnum):
    """Phase of a request."""

    ASKED = "asked"
    """Sent; the controller has not answered it yet."""
    SEEN = "seen"
    """Read by the controller."""
    DONE = "done"
    """In force: the controller is, or was, in the requested state."""
    REFUSED = "refused"
    """Read by the controller without effect."""
    RETRACTED = "retracted"
    """Given up before its end was known; the opposite request was sent after it."""


@dataclass(slots=True, kw_only=True)
class StateRequest:
    """One request."""

    state: Fsm
    """The requested state."""
    asked_s: float
    """Time at which it was asked first [s]."""
    number: int = 0
    """Number of its last command, as `CommandPacer` counts."""
    phase: RequestPhase = RequestPhase.ASKED


class StateRequester:
    """Requests of states to one controller; it expects the driver's lock, as the client does.

    Args:
        client: connection to the controller.
    """

    def __init__(self, client: Z1Client) -> None:
        self._client = client
        self.last: StateRequest | None = None
        """The last request."""

    def request(
        self, requested: Fsm, body: JointCommands | TrajectoryCommand | str | None = None, *, timeout_s: float = 0.3
    ) -> None:
        """Request a state until the controller is in it; from then on request no change, with the same body.

        Args:
            requested: the state.
            body: None = the present posture, which LOWCMD obeys for a cycle before it is left.
            timeout_s: how long the state may take once the request was seen [s].

        Raises:
            CommandRejectedError: the transition is not allowed (`transition_not_allowed`), the controller has seen the
                request and does not follow (`request_refused`), or a stop interrupted it (`cancelled`).
            HalTimeoutError: it has not seen the request (`request_unread`), or moves otherwise than requested
                (`request_unconfirmed`).
        """
        client = self._client
        present = client.newest.state
        client.expected = None
        if not is_granted(present, requested):
            raise CommandRejectedError(
                f"Z1: the controller does not change from {present.name} to {requested.name}. "
                f"{_REMEDIES.get(requested, _DEFAULT_REMEDY)}",
                code="transition_not_allowed",
            )
        if body is None:
            body = client.posture()
        self.last = request = StateRequest(state=requested, asked_s=client.clock.now_s())
        moving = self._speed() > _MOVING_RAD_S
        try:
            client.settle()
            for _ in range(_TRIES):
                if self._ask(request, body, timeout_s):
                    break
                self._check_unconfirmed(request, moving)
            else:
                raise self._refuse(request)
            if requested in MOVES and requested is not Fsm.SAVESTATE:
                self._await_start(request)
        except HalError:
            if request.phase is not RequestPhase.REFUSED:
                self._retract(request, present)
            client.write_joints(client.posture(), track=False)
            raise
        request.phase = RequestPhase.DONE

    def wait_for_state(self, state: Fsm, timeout_s: float) -> None:
        """Exchange datagrams until the controller is in `state`.

        Raises:
            HalTimeoutError: it is not after `timeout_s` [s], or it stopped answering.
        """
        client = self._client
        if not client.exchange_until(lambda: client.newest.state is state, timeout_s):
            client.check_age()
            raise HalTimeoutError(
                f"Z1: the controller is in {client.newest.state.name} after {timeout_s} s; expected is {state.name}.",
                code="state_timeout",
            )

    def calibrate(self, timeout_s: float) -> None:
        """Request the calibration of the zero, during which the controller is silent, and wait for its end.

        CALIBRATION never shows in an answer (measured): the measured joints, zero afterwards, prove it.

        Raises:
            HalTimeoutError: the joints are not at zero after `timeout_s` [s].
        """
        client = self._client
        self.last = request = StateRequest(state=Fsm.CALIBRATION, asked_s=client.clock.now_s())
        client.settle()
        client.visited.clear()
        first = client.pacer.sent
        packed = encode_command(Fsm.CALIBRATION, client.posture())
        client.exchange_until(lambda: client.pacer.sent >= first + _REPEATS, timeout_s, packed)
        request.number = client.pacer.sent

        def is_zero() -> bool:
            q = client.newest.joints.q[: z1.N_ARM]
            seen = client.pacer.answered >= request.number and len(client.visited) > _REPEATS
            return seen and client.newest.state is Fsm.PASSIVE and bool(np.abs(q).max() < _CALIBRATED_RAD)

        if not client.exchange_until(is_zero, timeout_s):
            raise HalTimeoutError(
                f"Z1: {timeout_s:.0f} s after the request for a calibration the joints are at "
                f"{np.round(client.newest.joints.q[: z1.N_ARM], 3)} rad in {client.newest.state.name}; they should be "
                f"at zero in PASSIVE. Restart `z1_ctrl`, and inspect the arm.",
                code="calibration_failed",
            )
        request.phase = RequestPhase.DONE

    # --- Inside -------------------------------------------------------------------------------------------------

    def _ask(self, request: StateRequest, body: JointCommands | TrajectoryCommand | str, timeout_s: float) -> bool:
        """Send the request; return whether its state showed within `timeout_s` after it was seen."""
        client, clock = self._client, self._client.clock
        client.visited.clear()
        client.carries_joints = isinstance(body, JointCommands)
        client.command.data[:] = encode_command(Fsm.INVALID, body)  # harmless before, and the same afterwards
        packed, asked_s = encode_command(request.state, body), clock.now_s()
        request.phase, request.number, left = RequestPhase.ASKED, 0, _REPEATS

        def exchange_until(reached: Callable[[], bool], duration_s: float) -> bool:
            nonlocal left
            end_s = clock.now_s() + duration_s
            while clock.now_s() < end_s:
                if client.exchange_until(reached, z1.CONTROL_PERIOD_S, packed if left else None):
                    return True
                if left and client.pacer.sent > request.number:
                    left, request.number = left - 1, client.pacer.sent
            return False

        def has_effect() -> bool:
            if not left and request.phase is RequestPhase.ASKED and client.pacer.answered >= request.number:
                request.phase = RequestPhase.SEEN
            return request.state in client.visited

        if not exchange_until(lambda: has_effect() or request.phase is RequestPhase.SEEN, _UNREAD_S):
            raise HalTimeoutError(
                f"Z1: the controller at {client.link.describe()} has not read a request for {request.state.name} for "
                f"{clock.now_s() - asked_s:.1f} s. It was taken back; a controller that is only busy may still begin "
                f"it. Keep away from the arm, and restart `z1_ctrl` if it stays silent.",
                code="request_unread",
            )
        if has_effect() or exchange_until(has_effect, timeout_s):
            return True
        while len(client.visited) < _MIN_ANSWERS and clock.now_s() - client.newest_s < _UNREAD_S:
            if exchange_until(has_effect, timeout_s):
                return True
        return False

    def _await_start(self, request: StateRequest) -> None:
        """Wait until a motion has shown for longer than one that is refused.

        Raises:
            CommandRejectedError: it was refused.
        """
        client, ended = self._client, 0

        def is_decided() -> bool:
            nonlocal ended
            newest = list(client.visited)
            ended = next((i for i, state in enumerate(reversed(newest)) if state is request.state), len(newest))
            return ended >= _ENDED or newest[-_STARTED:].count(request.state) == _STARTED

        client.exchange_until(is_decided, _UNREAD_S)
        if ended >= _ENDED and self._speed() < _MOVING_RAD_S:
            raise self._refuse(request)

    def _refuse(self, request: StateRequest) -> CommandRejectedError:
        request.phase = RequestPhase.REFUSED
        state = self._client.newest.state.name
        if request.state in MOVES:
            detail = "an unknown label, an empty recording, or a pose out of reach"
        else:
            detail = "it is in a state in which it does not follow"
        return CommandRejectedError(
            f"Z1: the controller has read the request for {request.state.name} and refuses it: {detail}. It is in "
            f"{state}, and nothing moves by this request.",
            code="request_refused",
        )

    def _check_unconfirmed(self, request: StateRequest, was_moving: bool) -> None:
        """Raise when the arm moves although the requested state does not show: that is no refusal."""
        client = self._client
        state = client.newest.state
        if state is not Fsm.PASSIVE and not was_moving and self._speed() > _MOVING_RAD_S:
            raise HalTimeoutError(
                f"Z1: after a request for {request.state.name} the arm moves at {self._speed():.2f} rad/s in "
                f"{state.name}. It was taken back. Keep away from the arm until it rests.",
                code="request_unconfirmed",
            )

    def _retract(self, request: StateRequest, present: Fsm) -> None:
        """Send the opposite of a request behind it: first in, first out, it ends what the request may begin."""
        client = self._client
        request.phase = RequestPhase.RETRACTED
        if request.number:
            back = Fsm.PASSIVE if present is Fsm.PASSIVE else Fsm.JOINTCTRL
            for _ in range(_REPEATS):
                client.pacer.forget()  # it must leave now, whatever is unanswered
                client.send(encode_command(back, client.posture()))

    def _speed(self) -> float:
        return float(np.abs(self._client.newest.joints.dq[: z1.N_ARM]).max())
