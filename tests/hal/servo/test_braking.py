"""Stops, blends and target tracking, each alone."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base.messages import TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S, DDQ_MAX, DQ_MAX, N_JOINTS, Q_MAX, Q_MIN
from hal.servo.braking import Blend, Brake, TargetTracker, plan_path_stop
from hal.servo.limits import ServoLimits
from hal.servo.trajectory_buffer import TrajectoryBuffer
from tests.support.hal.servo_bench import START, Bench

LIMITS = ServoLimits()
MIDDLE = (Q_MIN + Q_MAX) / 2
ZERO = np.zeros(N_JOINTS)


@pytest.mark.parametrize("ddq", [-DDQ_MAX, ZERO, DDQ_MAX])
@pytest.mark.parametrize("dq", [-DQ_MAX, 0.3 * DQ_MAX, DQ_MAX])
def test_a_stop_from_any_speed_and_acceleration_is_over_in_time(dq: np.ndarray, ddq: np.ndarray) -> None:
    path = Brake(LIMITS).plan(np.zeros(N_JOINTS) + MIDDLE, dq, ddq)
    assert path.duration_s <= ServoLimits().brake_s
    assert path.at(10.0)[1] == pytest.approx(ZERO, abs=1e-9)


def test_a_joint_near_its_limit_brakes_harder_and_the_others_do_not() -> None:
    q, dq = MIDDLE.copy(), 0.5 * np.sign(DQ_MAX)
    free = Brake(LIMITS).plan(q, dq, ZERO)
    q[4] = Q_MAX[4] - 0.015
    near = Brake(LIMITS).plan(q, dq, ZERO)
    times = np.arange(0, 0.5, CONTROL_PERIOD_S)
    path = np.array([near.at(t)[0] for t in times])
    assert path[:, 4].max() <= Q_MAX[4] + 1e-9
    others = [j for j in range(N_JOINTS) if j != 4]
    assert path[:, others] == pytest.approx(np.array([free.at(t)[0] for t in times])[:, others])


def test_a_blend_decays_within_the_acceleration_limits() -> None:
    q, dq = np.linspace(-0.05, 0.05, N_JOINTS), np.linspace(1.0, -1.0, N_JOINTS)
    blend = Blend(q, dq, DDQ_MAX)
    times = np.arange(0, blend.duration_s + 0.01, CONTROL_PERIOD_S)
    path = np.array([blend.at(t)[0] for t in times])
    rate = np.array([blend.at(t)[1] for t in times])
    assert path[0] == pytest.approx(q)
    assert rate[0] == pytest.approx(dq)
    assert path[-1] == pytest.approx(ZERO)
    assert np.gradient(path, times, axis=0)[1:-1] == pytest.approx(rate[1:-1], abs=0.02)
    assert (np.abs(np.diff(rate, axis=0)) / CONTROL_PERIOD_S <= DDQ_MAX + 1e-6).all()


def test_tracking_ends_at_the_joint_limit_when_the_target_is_beyond_it() -> None:
    tracker = TargetTracker(LIMITS)
    q, dq, ddq = MIDDLE, ZERO, ZERO
    for _ in range(1500):
        q, dq, ddq = tracker.step(Q_MAX + 1.0, q, dq, ddq)
        assert (q <= Q_MAX + 1e-6).all()
        assert (np.abs(dq) <= DQ_MAX + 1e-9).all()
        assert (np.abs(ddq) <= DDQ_MAX + 1e-9).all()
    assert q == pytest.approx(Q_MAX)
    assert dq == pytest.approx(ZERO, abs=1e-6)


# --- On the path ----------------------------------------------------------------------------------------------------


def circle(duration_s: float, speed: float = 1.0) -> TrajectoryBuffer:
    """Return joints 1 and 2 on a circle of 0.3 rad; on a straight line every kind of braking would stay on the path."""
    t_s = np.arange(0.0, duration_s + 1e-9, 0.02)
    q, dq = np.zeros((len(t_s), N_JOINTS)), np.zeros((len(t_s), N_JOINTS))
    turn = speed / 0.3
    q[:, 0], q[:, 1] = 0.3 * np.cos(turn * t_s), 0.3 * np.sin(turn * t_s)
    dq[:, 0], dq[:, 1] = -speed * np.sin(turn * t_s), speed * np.cos(turn * t_s)
    return TrajectoryBuffer(1, t_s.tolist(), q, dq, False)


@pytest.mark.parametrize("speed", [0.05, 0.5, 1.0])
def test_a_stop_on_the_path_stays_on_it_and_begins_and_ends_without_a_jump(speed: float) -> None:
    path = circle(1.0, speed)
    stop = plan_path_stop(path, 0.5, LIMITS)
    assert stop is not None
    t_s = np.arange(0.0, stop.duration_s + 0.01, CONTROL_PERIOD_S)
    q, dq = (np.array(x) for x in zip(*(stop.at(t) for t in t_s), strict=True))
    assert np.hypot(q[:, 0], q[:, 1]) == pytest.approx(np.full(len(q), 0.3), abs=1e-5)
    assert q[0] == pytest.approx(path.at(0.5)[0])
    assert dq[0] == pytest.approx(path.at(0.5)[1])
    assert not dq[-1].any()
    assert np.diff(q, axis=0) / CONTROL_PERIOD_S == pytest.approx((dq[1:] + dq[:-1]) / 2, abs=2e-3)
    assert stop.duration_s <= LIMITS.brake_s


def test_a_path_that_is_too_short_has_no_path_stop() -> None:
    path = circle(1.0)
    assert plan_path_stop(path, 0.99, LIMITS) is None
    assert plan_path_stop(path, 0.80, LIMITS) is not None


def test_a_stopped_arm_stays_on_its_path_if_it_bends() -> None:
    """The same path, played by the servo: from home along the circle, then the stop."""
    start = START.copy()
    path = circle(1.5, 0.6)
    shift = start - path.q[0]
    ramp = np.array(path.t_s) / 1.5
    time_scale = ramp**2 * (2.0 - ramp)  # from rest: the circle is played faster and faster
    pieces = [path.at(1.5 * s) for s in time_scale]
    rate = ramp * (4.0 - 3.0 * ramp)
    chunk = TrajectoryChunk(
        trajectory_id=1,
        t_s=np.array(path.t_s),
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
