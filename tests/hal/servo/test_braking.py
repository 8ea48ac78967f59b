"""Stops, moves and target tracking, each alone."""

from __future__ import annotations

import numpy as np
import pytest
from ruckig import ControlInterface, InputParameter, Ruckig, Synchronization, Trajectory

from hal.base.messages import TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S, DDQ_MAX, DQ_MAX, N_JOINTS, Q_MAX, Q_MIN
from hal.servo.braking import JointMove, JointStop, MotionState, PathStop, TargetTracker, path_stop_durations
from hal.servo.limits import ServoLimits
from hal.servo.trajectory_buffer import TrajectoryBuffer
from tests.support.hal.servo_bench import START, Bench

LIMITS = ServoLimits()
MIDDLE = (Q_MIN + Q_MAX) / 2
ZERO = np.zeros(N_JOINTS)


def sample(stop: JointStop) -> np.ndarray:
    """Return the stop's positions at the ticks, with its beginning and three at rest, (N, 7)."""
    times = np.arange(0.0, stop.duration_s + 4 * CONTROL_PERIOD_S, CONTROL_PERIOD_S)
    return np.array([stop.at(t)[0] for t in times])


@pytest.mark.parametrize("ddq", [-DDQ_MAX, ZERO, DDQ_MAX])
@pytest.mark.parametrize("dq", [-DQ_MAX, 0.3 * DQ_MAX, DQ_MAX])
def test_a_stop_from_any_speed_and_acceleration_is_over_in_time(dq: np.ndarray, ddq: np.ndarray) -> None:
    stop = JointStop(MotionState(MIDDLE, dq, ddq), LIMITS.brake_ddq_max, LIMITS.brake_dddq_max)
    assert stop.duration_s <= ServoLimits().brake_s
    assert stop.at(10.0)[1] == pytest.approx(ZERO, abs=1e-9)
    assert stop.at(10.0)[0] == pytest.approx(stop.q_rest)


@pytest.mark.parametrize("seed", range(20))
def test_a_stop_is_the_fastest_within_acceleration_and_jerk(seed: int) -> None:
    rng = np.random.default_rng(seed)
    dq, ddq = DQ_MAX * rng.uniform(-1, 1, N_JOINTS) ** 3, DDQ_MAX * rng.uniform(-1, 1, N_JOINTS)
    stop = JointStop(MotionState(MIDDLE, dq, ddq), LIMITS.ddq_max, LIMITS.dddq_max)
    q = sample(stop)
    assert (np.abs(np.diff(q, n=2, axis=0)) <= LIMITS.ddq_max * CONTROL_PERIOD_S**2 + 1e-12).all()
    assert (np.abs(np.diff(q, n=3, axis=0)) <= LIMITS.dddq_max * CONTROL_PERIOD_S**3 + 1e-12).all()
    assert np.diff(q[:2], axis=0)[0] == pytest.approx(CONTROL_PERIOD_S * dq, abs=3e-5)
    request, path = InputParameter(N_JOINTS), Trajectory(N_JOINTS)
    request.control_interface, request.synchronization = ControlInterface.Velocity, Synchronization.No
    request.current_position, request.current_velocity = MIDDLE.tolist(), dq.tolist()
    request.current_acceleration = ddq.tolist()
    request.max_acceleration, request.max_jerk = LIMITS.ddq_max.tolist(), LIMITS.dddq_max.tolist()
    Ruckig(N_JOINTS).calculate(request, path)
    assert stop.q_rest == pytest.approx(path.at_time(path.duration)[0], abs=1e-6)
    assert stop.duration_s == pytest.approx(path.duration, abs=1e-6)


def test_the_checked_positions_of_a_stop_begin_and_end_with_it() -> None:
    stop = JointStop(MotionState(MIDDLE, DQ_MAX, ZERO), LIMITS.brake_ddq_max, LIMITS.brake_dddq_max)
    q = stop.positions()
    assert q[0] == pytest.approx(MIDDLE)
    assert q[-1] == pytest.approx(stop.q_rest)
    assert np.abs(np.diff(q, axis=0)).max() < 0.02


def test_a_move_ends_at_its_goal_within_the_limits() -> None:
    goal = MIDDLE + np.linspace(-0.4, 0.4, N_JOINTS)
    move = JointMove(MIDDLE, goal, LIMITS)
    q = np.array([move.at(t).q for t in np.arange(0.0, move.duration_s + 0.01, CONTROL_PERIOD_S)])
    assert q[0] == pytest.approx(MIDDLE)
    assert (q[-1] == goal).all()
    assert (np.abs(np.diff(q, n=3, axis=0)) <= 1.01 * LIMITS.dddq_max * CONTROL_PERIOD_S**3).all()


def test_tracking_ends_at_the_joint_limit_when_the_target_is_beyond_it() -> None:
    tracker = TargetTracker(LIMITS)
    q, dq, ddq = state = MotionState(MIDDLE, ZERO, ZERO)
    for _ in range(1500):
        q, dq, ddq = state = tracker.step(Q_MAX + 1.0, state)
        assert (q <= Q_MAX + 1e-6).all()
        assert (np.abs(dq) <= DQ_MAX + 1e-9).all()
        assert (np.abs(ddq) <= DDQ_MAX + 1e-9).all()
    assert q == pytest.approx(Q_MAX)
    assert dq == pytest.approx(ZERO, abs=1e-6)


# --- On the path ----------------------------------------------------------------------------------------------------


def circle(duration_s: float, speed: float = 1.0) -> TrajectoryBuffer:
    """Return joints 1 and 2 on a circle of 0.3 rad; on a straight line every kind of braking would stay on the path."""
    t_s = np.arange(0.0, duration_s + 1e-9, CONTROL_PERIOD_S)
    q, dq = np.zeros((len(t_s), N_JOINTS)), np.zeros((len(t_s), N_JOINTS))
    turn = speed / 0.3
    q[:, 0], q[:, 1] = 0.3 * np.cos(turn * t_s), 0.3 * np.sin(turn * t_s)
    dq[:, 0], dq[:, 1] = -speed * np.sin(turn * t_s), speed * np.cos(turn * t_s)
    return TrajectoryBuffer(1, t_s.tolist(), q, dq, False, path_stop_durations(dq, LIMITS))


@pytest.mark.parametrize("speed", [0.05, 0.5, 1.0])
def test_a_stop_on_the_path_stays_on_it_and_begins_and_ends_without_a_jump(speed: float) -> None:
    path = circle(1.0, speed)
    stop = PathStop(path, 0.5)
    t_s = np.arange(0.0, stop.duration_s + 0.01, CONTROL_PERIOD_S)
    q, dq = (np.array(x) for x in zip(*(stop.at(t) for t in t_s), strict=True))
    assert np.hypot(q[:, 0], q[:, 1]) == pytest.approx(np.full(len(q), 0.3), abs=1e-5)
    assert q[0] == pytest.approx(path.at(0.5)[0])
    assert dq[0] == pytest.approx(path.at(0.5)[1])
    assert not dq[-1].any()
    assert np.diff(q, axis=0) / CONTROL_PERIOD_S == pytest.approx((dq[1:] + dq[:-1]) / 2, abs=2e-3)
    assert stop.duration_s <= LIMITS.brake_s


def test_the_path_ends_too_early_for_a_stop_near_its_end() -> None:
    path = circle(1.0)
    assert not path.can_stop_from(0.99)
    assert path.can_stop_from(0.80)


@pytest.mark.integration
def test_a_stopped_arm_stays_on_its_path_if_it_bends() -> None:
    """The same path, played by the servo: from home along the circle, then the stop."""
    path = circle(1.5, 0.6)
    shift = START - path.q[0]
    t_s = np.arange(0.0, 1.5, 0.01)
    # From rest, within the jerk's limit: the circle is played faster and faster.
    along = 0.4 * t_s**3 - 0.08 * t_s**4
    rate = 1.2 * t_s**2 - 0.32 * t_s**3
    pieces = [path.at(float(s)) for s in along]
    chunk = TrajectoryChunk(
        trajectory_id=1,
        t_s=t_s,
        q=np.array([q for q, _ in pieces]) + shift,
        dq=np.array([r * dq for r, (_, dq) in zip(rate, pieces, strict=True)]),
    )
    bench = Bench()
    bench.servo.stream(chunk)
    bench.run(1.1)
    bench.servo.stop("the button")
    bench.run_until_at_rest()
    q = bench.commanded() - shift
    assert np.hypot(q[:, 0], q[:, 1]) == pytest.approx(np.full(len(q), 0.3), abs=1e-4)
    assert np.abs(np.diff(q, n=2, axis=0)).max() / CONTROL_PERIOD_S**2 < 1.5 * DDQ_MAX.max()
