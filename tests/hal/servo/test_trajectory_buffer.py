"""The trajectory buffer alone; the rejections of a whole servo are in `test_command_mailbox.py`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from hal.base.errors import CommandRejectedError
from hal.base.messages import TrajectoryChunk
from hal.servo.limits import ServoLimits
from hal.servo.trajectory_buffer import TrajectoryBuffer, extend_buffer, start_buffer
from tests.support.errors import raises
from tests.support.hal.servo_bench import START, STEP, move

LIMITS = ServoLimits()


def test_interpolation_is_the_cubic_hermite_spline_and_holds_the_ends() -> None:
    chunk = move()
    buffer = start_buffer(chunk, LIMITS)
    spline = CubicHermiteSpline(chunk.t_s, chunk.q, chunk.dq)
    for t_s in np.linspace(0.0, 1.0, 173):
        q, dq = buffer.at(float(t_s))
        np.testing.assert_allclose(q, spline(t_s), atol=1e-12)
        np.testing.assert_allclose(dq, spline(t_s, 1), atol=1e-9)
    np.testing.assert_array_equal(buffer.at(-1.0)[0], chunk.q[0])
    np.testing.assert_array_equal(buffer.at(9.0)[0], chunk.q[-1])


@pytest.mark.parametrize("repeats_last_point", [True, False])
def test_an_extended_buffer_is_the_whole_trajectory(repeats_last_point: bool) -> None:
    whole = start_buffer(move(), LIMITS)
    buffer = start_buffer(move(until_s=0.4), LIMITS)
    buffer = extend_buffer(buffer, move(from_s=0.4 if repeats_last_point else 0.42), 0.0, LIMITS)
    assert buffer.final
    assert buffer.t_s == pytest.approx(whole.t_s)
    np.testing.assert_allclose(buffer.q, whole.q, atol=1e-12)


def test_extending_drops_the_points_that_were_played() -> None:
    buffer = extend_buffer(start_buffer(move(until_s=0.4), LIMITS), move(from_s=0.4), 0.36, LIMITS)
    assert 0.2 < buffer.t_s[0] <= 0.26, "0.1 s before the played time is kept"
    assert buffer.end_s == pytest.approx(1.0)


def test_positions_are_sampled_to_the_end_and_the_end_is_included() -> None:
    buffer = start_buffer(move(), LIMITS)
    samples = buffer.sample_positions(0.5, 0.3)
    expected = [buffer.at(t_s)[0] for t_s in (0.5, 0.8, 1.0)]
    np.testing.assert_array_equal(samples, expected)


def test_another_position_at_the_repeated_time_is_rejected() -> None:
    buffer = start_buffer(move(until_s=0.4), LIMITS)
    with raises(CommandRejectedError, "position_jump"):
        extend_buffer(buffer, move(from_s=0.4, start=START + 0.02), 0.0, LIMITS)


@pytest.mark.parametrize(("dq_end", "code"), [(0.5, "acceleration_limit"), (0.02, "jerk_limit")])
def test_accelerations_and_jerks_beyond_the_limits_are_rejected(dq_end: float, code: str) -> None:
    """A speed that starts at once: 0.5 rad/s in 20 ms is 25 rad/s²; 0.02 rad/s is 1 rad/s², reached within 20 ms."""
    t_s = np.array([0.0, 0.01, 0.02, 0.04])
    dq = np.zeros((4, 7))
    dq[2:, 0] = dq_end
    q = np.tile(START, (4, 1))
    q[2, 0] += dq_end * 0.005
    q[3, 0] += dq_end * 0.025
    with raises(CommandRejectedError, code):
        start_buffer(TrajectoryChunk(trajectory_id=1, t_s=t_s, q=q, dq=dq), LIMITS)


def test_a_buffer_is_replaced_and_never_changed() -> None:
    first = start_buffer(move(until_s=0.4), LIMITS)
    before = TrajectoryBuffer(first.trajectory_id, list(first.t_s), first.q.copy(), first.dq.copy(), first.final)
    extend_buffer(first, move(from_s=0.4, step=STEP), 0.2, LIMITS)
    assert first.t_s == before.t_s
    np.testing.assert_array_equal(first.q, before.q)
    assert not first.final
