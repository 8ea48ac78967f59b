"""Client of a conformance run: requests as the vendor's library makes them, and what is seen of them."""

from __future__ import annotations

from itertools import groupby

import numpy as np

from hal.base import z1
from hal.z1_protocol.controller import ControllerState, TrajectoryCommand, encode_command
from hal.z1_protocol.records import JointCommands
from hal.z1_protocol.states import Fsm
from tests.support.vendor.line import Line

PERIOD_S = 0.004
"""Period of the client [s]: the controller reads faster, so that nothing queues."""
_REQUEST_TIMEOUT_S = 0.1
_SETTLE_TIMEOUT_S = 20.0

Body = JointCommands | TrajectoryCommand | str | None


class Probe:
    """A client of `line`."""

    def __init__(self, line: Line) -> None:
        self.line = line

    @property
    def newest(self) -> ControllerState:
        """The newest answer."""
        return self.line.answers[-1][1]

    @property
    def fsm(self) -> Fsm:
        """State of the controller."""
        return self.newest.state

    def hold(self, duration_s: float, data: bytes | None = None, period_s: float = PERIOD_S) -> None:
        """Send `data` for `duration_s` [s]; by default no request, with the present joints."""
        data = data if data is not None else self._body(Fsm.INVALID, None)
        end_s = self.line.now_s() + duration_s - 1e-9
        while self.line.now_s() < end_s:
            self.line.send(data)
            self.line.run(period_s)

    def ask(self, state: Fsm, body: Body = None, hold_s: float = 0.05) -> list[str]:
        """Request `state` until it is seen, then keep the same body; return the names of the states in a row.

        The body is kept because the controller reads it a step after it has granted the request.
        """
        since = len(self.line.answers)
        data, end_s = self._body(state, body), self.line.now_s() + _REQUEST_TIMEOUT_S
        while state not in self._seen(since) and self.line.now_s() < end_s:
            self.line.send(data)
            self.line.run(PERIOD_S)
        self.hold(hold_s, data[:2] + bytes(4) + data[6:])
        return [name for name, _ in groupby(fsm.name for fsm in self._seen(since))]

    def wait_for(self, state: Fsm, data: bytes | None = None) -> float:
        """Send `data` until the controller is in `state`; return how long that took [s]."""
        start_s = self.line.now_s()
        while self.fsm is not state and self.line.now_s() < start_s + _SETTLE_TIMEOUT_S:
            self.hold(PERIOD_S, data)
        return self.line.now_s() - start_s

    def go(self, state: Fsm) -> None:
        """Bring the controller into a state that holds, from any other."""
        self.wait_for(state, self._body(state, None))
        self.hold(0.05)

    def move(self, state: Fsm, body: Body = None) -> float:
        """Execute a motion; return the time for which its state was shown [s]."""
        since = len(self.line.answers)
        self.ask(state, body, hold_s=PERIOD_S)
        data = self._body(Fsm.INVALID, body)
        end_s = self.line.now_s() + _SETTLE_TIMEOUT_S
        while self.fsm is state and self.line.now_s() < end_s:
            self.hold(PERIOD_S, data)
        times = [t_s for t_s, answer in self.line.answers[since:] if answer.state is state]
        return times[-1] - times[0] if times else 0.0

    def track(self, q: np.ndarray, dq: np.ndarray | None = None) -> bytes:
        """Return a tracking command to the joints `q` (7,) [rad]."""
        return encode_command(
            Fsm.INVALID, JointCommands(q=q, dq=np.zeros(z1.N_JOINTS) if dq is None else dq), track=True
        )

    def _seen(self, since: int) -> list[Fsm]:
        return [answer.state for _, answer in self.line.answers[since:]]

    def _body(self, state: Fsm, body: Body) -> bytes:
        return encode_command(state, JointCommands(q=self.newest.joints.q) if body is None else body)


def move_from(pose: np.ndarray, *steps: tuple[float, ...], speed: float, gripper: float = -0.5) -> TrajectoryCommand:
    """Return a move to postures that are `steps` (6,) away from `pose` (6,) [rad, m]."""
    poses = np.zeros((2, 6))
    poses[: len(steps)] = [pose + np.array(step) for step in steps]
    return TrajectoryCommand(poses=poses, gripper_rad=gripper, max_speed=speed)
