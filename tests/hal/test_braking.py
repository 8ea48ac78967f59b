"""Stops, blends and chases by themselves."""

from __future__ import annotations

import numpy as np
import pytest

from hal.braking import Blend, Brake, Chaser
from hal.limits import ServoLimits
from hal.z1 import CONTROL_PERIOD_S, DDQ_MAX, DQ_MAX, N_JOINTS, Q_MAX, Q_MIN

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


def test_a_blend_dies_out_within_the_acceleration_limits() -> None:
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


def test_a_chase_arrives_at_the_limit_when_its_target_lies_beyond() -> None:
    chaser = Chaser(LIMITS)
    q, dq, ddq = MIDDLE, ZERO, ZERO
    for _ in range(1500):
        q, dq, ddq = chaser.step(Q_MAX + 1.0, q, dq, ddq)
        assert (q <= Q_MAX + 1e-6).all()
        assert (np.abs(dq) <= DQ_MAX + 1e-9).all()
        assert (np.abs(ddq) <= DDQ_MAX + 1e-9).all()
    assert q == pytest.approx(Q_MAX)
    assert dq == pytest.approx(ZERO, abs=1e-6)
