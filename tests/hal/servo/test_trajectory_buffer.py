"""The trajectory buffer alone; the rejections of a whole servo are in `test_command_mailbox.py`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from hal.base.errors import CommandRejectedError
from hal.base.messages import TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S
from hal.servo.limits import ServoLimits
from hal.servo.trajectory_buffer import extend_buffer, start_buffer
from tests.support.errors import raises
from tests.support.hal.servo_bench import START, STEP, move

LIMITS = ServoLimits()


def test_the_setpoints_are_on_the_cubic_hermite_spline_and_the_ends_are_held() -> None:
    chunk = move()
    buffer = start_buffer(chunk, LIMITS)
    spline = CubicHermiteSpline(chunk.t_s, chunk.q, chunk.dq)
    for tick in range(0, 501, 7):
        q, dq = buffer.at(tick * CONTROL_PERIOD_S)
        np.testing.assert_allclose(q, spline(tick * CONTROL_PERIOD_S), atol=1e-12)
        np.testing.assert_allclose(dq, spline(tick * CONTROL_PERIOD_S, 1), atol=1e-9)
    between = np.linspace(0.0, 1.0, 173)
    np.testing.assert_allclose([buffer.at(float(t))[0] for t in between], spline(between), atol=1e-9)
    np.testing.assert_array_equal(buffer.at(-1.0)[0], chunk.q[0])
    np.testing.assert_array_equal(buffer.at(9.0)[0], chunk.q[-1])


def test_points_sent_at_the_servos_rate_are_played_to_the_last_bit() -> None:
    t_s = np.arange(501) * CONTROL_PERIOD_S
    dense = resampled(move(), t_s)
    buffer = start_buffer(dense, LIMITS)
    np.testing.assert_array_equal(buffer.q, dense.q)
    np.testing.assert_array_equal(buffer.dq, dense.dq)
    assert buffer.t_s == t_s.tolist()


def resampled(chunk: TrajectoryChunk, t_s: np.ndarray, *, final: bool = True) -> TrajectoryChunk:
    spline = CubicHermiteSpline(chunk.t_s, chunk.q, chunk.dq)
    return TrajectoryChunk(trajectory_id=1, t_s=t_s, q=spline(t_s), dq=spline(t_s, 1), final=final)


@pytest.mark.parametrize("seam_s", [0.4, 0.4007, 0.4013])
def test_a_seam_between_two_ticks_leaves_no_trace(seam_s: float) -> None:
    whole = move()
    first = resampled(whole, np.append(np.arange(0.0, seam_s - 1e-9, 0.01), seam_s), final=False)
    second = resampled(whole, np.append(seam_s, np.arange(0.42, 1.0 + 1e-9, 0.02)))
    buffer = extend_buffer(start_buffer(first, LIMITS), second, 0.0, LIMITS)
    expected = start_buffer(whole, LIMITS)
    np.testing.assert_allclose(buffer.t_s, expected.t_s, atol=1e-9)
    np.testing.assert_allclose(buffer.q, expected.q, atol=1e-6)


def test_a_trajectory_that_ends_between_two_ticks_holds_its_end() -> None:
    chunk = move(duration_s=1.0013)
    buffer = start_buffer(chunk, LIMITS)
    assert buffer.end_s == pytest.approx(1.002)
    np.testing.assert_array_equal(buffer.q[-1], chunk.q[-1])


def test_a_stop_from_any_point_ends_on_the_buffered_path_or_the_point_is_not_played() -> None:
    buffer = start_buffer(move(until_s=0.5), LIMITS)
    playable = [t_s for t_s in buffer.t_s if buffer.can_stop_from(t_s)]
    assert 0.35 < playable[-1] < 0.45
    for t_s in playable:
        assert t_s + 0.5 * buffer.stop_duration(t_s) <= 0.5 + 1e-6


@pytest.mark.parametrize("duration_s", [21.0, 60_000.0, 9e5])
def test_a_buffer_that_is_too_long_is_rejected_before_it_is_sampled(duration_s: float) -> None:
    still = np.tile(START, (2, 1))
    chunk = TrajectoryChunk(trajectory_id=1, t_s=np.array([0.0, duration_s]), q=still, dq=0 * still)
    with raises(CommandRejectedError, "buffer_full"):
        start_buffer(chunk, LIMITS)


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
    t_s, q = list(first.t_s), first.q.copy()
    extend_buffer(first, move(from_s=0.4, step=STEP), 0.2, LIMITS)
    assert first.t_s == t_s
    np.testing.assert_array_equal(first.q, q)
    assert not first.final
