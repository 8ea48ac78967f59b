"""Trajectories through the real servo in lock-step: played to the end, or rejected, dropped and lost with a reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from hal.base.errors import CommandRejectedError, HalTimeoutError, InvalidMessageError, InvalidValueError, StoppedError
from hal.base.messages import ServoMode, TrajectoryChunk
from tests.support.errors import raises
from tests.support.lockstep import Bench
from z1_runtime.motion.executor import Executor, ExecutorConfig, MotionError
from z1_runtime.motion.trajectory import hold, joint_move

Q_START = np.append(z1.Q_HOME, -1.0)
Q_GOAL = Q_START + np.array([0.5, 0.2, -0.3, 0.2, 0.1, -0.4, 0.3])
MOVE = joint_move(Q_START, Q_GOAL)


@pytest.fixture
def bench() -> Bench:
    return Bench(Q_START)


@pytest.fixture
def executor(bench) -> Executor:
    return Executor(bench.servo, bench.clock)


def corrupted(row: int):
    q = MOVE.q.copy()
    q[row, 2] = np.nan
    return replace(MOVE, q=q)


def rests_where_it_is(bench: Bench) -> bool:
    """Whether the arm holds one place, which is not the goal."""
    bench.wait(0.5)
    before = bench.servo.read_state().q
    bench.wait(0.5)
    after = bench.servo.read_state().q
    return np.abs(after - before).max() < 1e-6 and np.abs(after - Q_GOAL).max() > 0.05


def test_a_motion_is_played_to_its_end_and_takes_as_long_as_planned(bench, executor):
    executor.execute(MOVE)
    took_s = bench.clock.now_s()
    assert MOVE.duration_s <= took_s <= MOVE.duration_s + 2 * ExecutorConfig().poll_s
    state = executor.settle()
    assert state.q == pytest.approx(Q_GOAL, abs=1e-3)
    assert bench.servo.status().finished


@pytest.mark.integration
def test_motions_follow_each_other_without_a_gap_in_their_numbers(bench, executor):
    for motion in (MOVE, hold(Q_GOAL, 0.1), joint_move(Q_GOAL, Q_START)):
        executor.execute(motion)
    assert bench.servo.status().trajectory_id == 3
    assert executor.settle().q == pytest.approx(Q_START, abs=1e-3)


def test_no_more_than_the_lead_waits_at_the_servo(bench, executor):
    waiting = []
    executor.watchers.append(lambda state, status: waiting.append(status.buffered_s))
    executor.execute(MOVE)
    config = ExecutorConfig()
    assert max(waiting) <= config.lead_s + config.chunk_s
    middle = waiting[3:-20]
    assert len(middle) > 10
    assert min(middle) >= config.lead_s - config.poll_s - z1.CONTROL_PERIOD_S


def test_a_stop_in_mid_motion_is_an_error_and_leaves_the_arm_at_rest(bench, executor):
    bench.at_time(0.4, lambda: bench.servo.stop("red button"))
    with pytest.raises((MotionError, StoppedError)) as caught:
        executor.execute(MOVE)
    assert "red button" in str(caught.value)
    assert rests_where_it_is(bench)
    assert bench.servo.status().mode is ServoMode.STOPPED


@pytest.mark.integration
def test_nothing_moves_while_the_stop_is_latched_and_motions_run_after_rearming(bench, executor):
    bench.servo.stop("red button")
    bench.wait(0.1)
    with raises(StoppedError, "stopped"):
        executor.execute(MOVE)
    assert rests_where_it_is(bench)
    bench.servo.rearm()
    bench.servo.claim("test")
    bench.wait(0.1)
    executor.execute(MOVE)
    assert executor.settle().q == pytest.approx(Q_GOAL, abs=1e-3)


def test_a_fault_of_the_arm_in_mid_motion_is_an_error(bench, executor):
    bench.at_time(0.4, lambda: bench.mock.inject_fault("overheat joint 2"))
    with pytest.raises((MotionError, StoppedError)) as caught:
        executor.execute(MOVE)
    assert "overheat joint 2" in str(caught.value)
    assert rests_where_it_is(bench)


def test_a_blocked_joint_is_named(bench, executor):
    bench.at_time(0.3, lambda: bench.mock.block(0))
    with pytest.raises((MotionError, StoppedError)) as caught:
        executor.execute(MOVE)
    assert "joint1" in str(caught.value)


def test_a_runtime_that_pauses_starves_the_servo_and_gets_an_error(bench, executor):
    naps = [0.0] * 10 + [1.0]

    def nap(state, status):
        bench.wait(naps.pop(0) if naps else 0.0)

    executor.watchers.append(nap)
    with pytest.raises((MotionError, CommandRejectedError)):
        executor.execute(MOVE)
    assert rests_where_it_is(bench)


def test_a_rejected_chunk_in_mid_motion_is_an_error_and_the_arm_brakes(bench, executor):
    stream = bench.servo.stream
    taken = []

    def reject_the_fifth(chunk: TrajectoryChunk) -> None:
        if len(taken) == 4:
            raise CommandRejectedError("joint3 would be 2.9 rad; allowed is 0.")
        taken.append(chunk)
        stream(chunk)

    bench.servo.stream = reject_the_fifth
    with raises(CommandRejectedError, "command_rejected"):
        executor.execute(MOVE)
    assert rests_where_it_is(bench)


def test_a_motion_that_starts_elsewhere_is_rejected_and_nothing_moves(bench, executor):
    elsewhere = joint_move(Q_START + 0.2 * np.array([1, 0, 0, 0, 0, 0, 0]), Q_GOAL)
    with pytest.raises(CommandRejectedError):
        executor.execute(elsewhere)
    assert rests_where_it_is(bench)
    assert bench.servo.status().trajectory_id == 0


@pytest.mark.parametrize("row", [0, len(MOVE.q) // 2, -1])
def test_a_value_that_is_not_finite_is_rejected_before_anything_moves(bench, executor, row):
    with pytest.raises(InvalidMessageError):
        executor.execute(corrupted(row))
    bench.wait(0.5)
    assert bench.servo.read_state().q == pytest.approx(Q_START, abs=1e-9)


def test_a_servo_that_was_restarted_in_mid_motion_is_noticed(bench, executor):
    def restart() -> None:
        bench.servo.disconnect()
        bench.servo.connect()

    bench.at_time(0.5, restart)
    with pytest.raises((MotionError, CommandRejectedError)) as caught:
        executor.execute(MOVE)
    assert "makes no progress after 0." in str(caught.value)
    assert "at trajectory 0" in str(caught.value)
    assert rests_where_it_is(bench)


def test_a_servo_whose_ticks_end_is_noticed_with_and_without_watchers(bench, executor):
    bench.at_time(0.5, lambda: bench.clock.each_tick.remove(bench.servo.tick))
    with raises(MotionError, "stalled"):
        executor.execute(MOVE)
    other = Bench(Q_START)
    watched = Executor(other.servo, other.clock)
    watched.watchers.append(lambda state, status: None)
    other.at_time(0.5, lambda: other.clock.each_tick.remove(other.servo.tick))
    with pytest.raises(HalTimeoutError):
        watched.execute(MOVE)


@pytest.mark.integration
def test_an_arm_that_will_not_rest_is_named(bench, executor):
    rng = np.random.default_rng(0)

    def shake() -> None:
        bench.mock.offset = np.append(0.0, np.append(rng.uniform(-0.02, 0.02), np.zeros(5)))

    bench.clock.each_tick.append(shake)
    with raises(MotionError, "not_settled") as caught:
        executor.settle()
    assert "joint2 still moves" in str(caught.value)
    assert "rest is 0.02 rad/s" in str(caught.value)


@pytest.mark.parametrize(
    "wrong", [{"lead_s": 0.05}, {"poll_s": 0.0}, {"settle_dq": float("nan")}, {"stall_timeout_s": -1.0}], ids=str
)
def test_an_invalid_configuration_is_rejected(wrong):
    with raises(InvalidValueError, "invalid_value"):
        ExecutorConfig(**wrong)
