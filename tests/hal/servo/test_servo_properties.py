"""Property: no stream of commands drives the arm beyond its speed and joint limits."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.base.errors import HalError
from hal.base.messages import TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S, DQ_MAX, N_JOINTS, Q_MAX, Q_MIN
from tests.support.hal.servo_bench import START, Bench, setpoint

joints = st.lists(st.floats(-1, 1), min_size=N_JOINTS, max_size=N_JOINTS).map(np.array)
chunks = st.tuples(
    st.just("chunk"),
    st.booleans(),  # a new trajectory?
    st.lists(st.tuples(st.floats(0.005, 0.2), joints, joints), min_size=1, max_size=5),
    st.booleans(),  # final?
    st.floats(0.02, 2.5),  # distance of the points, as a speed [rad/s]
)
events = st.one_of(
    chunks,
    chunks,
    st.tuples(st.just("run"), st.floats(0.002, 0.3)),
    st.tuples(st.just("send"), joints),
    st.tuples(st.just("stop")),
    st.tuples(st.just("rearm")),
    st.tuples(st.just("block"), st.integers(0, N_JOINTS - 1)),
)


class Player:
    """A careless sender that turns drawn events into calls."""

    def __init__(self) -> None:
        self.bench = Bench()
        self.accepted = 0
        self._id, self._t_s, self._q = 0, 0.0, START

    def play(self, event: tuple) -> None:
        kind, *arguments = event
        with suppress(HalError):  # the servo may reject a command; its setpoints are under test
            getattr(self, f"_{kind}")(*arguments)
        self.bench.run(0.02)

    def _chunk(self, new: bool, points: list, final: bool, speed: float) -> None:
        if new or self._id == 0:
            self._id, self._t_s = self.bench.servo.status().trajectory_id + 1, 0.0
            self._q = self.bench.servo.status().q_command
        t_s = self._t_s + np.concatenate([[0.0], np.cumsum([dt for dt, _, _ in points])])
        q = [self._q]
        for dt, direction, _ in points:
            q.append(np.clip(q[-1] + speed * dt * direction, Q_MIN, Q_MAX))
        dq = np.vstack([np.zeros(N_JOINTS), *(3.0 * rate for _, _, rate in points)])
        chunk = TrajectoryChunk(trajectory_id=self._id, t_s=t_s, q=np.array(q), dq=dq, final=final)
        self.bench.servo.stream(chunk)
        self.accepted += 1
        self._t_s, self._q = float(t_s[-1]), q[-1]

    def _run(self, duration_s: float) -> None:
        self.bench.run(duration_s)

    def _send(self, direction: np.ndarray) -> None:
        self.bench.servo.send(setpoint(START + 4.0 * direction))

    def _stop(self) -> None:
        self.bench.servo.stop()

    def _rearm(self) -> None:
        self.bench.arm.block(None)
        self.bench.servo.rearm()
        self.bench.servo.claim("test")

    def _block(self, joint: int) -> None:
        self.bench.arm.block(joint)


@settings(max_examples=60)
@given(st.lists(events, min_size=1, max_size=8))
def test_no_step_is_faster_than_the_joints_and_no_setpoint_is_outside_their_limits(drawn: list[tuple]) -> None:
    player = Player()
    for event in drawn:
        player.play(event)
    player.bench.run(0.5)
    q = player.bench.commanded()
    assert (np.abs(np.diff(q, axis=0)) <= DQ_MAX * CONTROL_PERIOD_S + 1e-12).all()
    assert (q >= Q_MIN).all()
    assert (q <= Q_MAX).all()


def test_the_careless_sender_gets_trajectories_accepted() -> None:
    player = Player()
    still = (0.1, np.full(N_JOINTS, 0.1), np.zeros(N_JOINTS))
    player.play(("chunk", True, [still], False, 1.0))
    player.play(("chunk", False, [still], True, 1.0))
    player.bench.run(0.5)
    assert player.accepted == 2
    assert player.bench.servo.status().finished
