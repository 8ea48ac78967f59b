"""What producers may ask of the servo, and what it refuses them."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base.errors import CommandRejectedError, LeaseError, NotConnectedError
from hal.base.messages import ServoMode, TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S, DDQ_MAX
from hal.servo.trajectory_buffer import MAX_POINTS
from tests.support.hal.servo_bench import ARM, START, STEP, Bench, move, setpoint

HOLDING = ServoMode.HOLDING


# --- What is refused ------------------------------------------------------------------------------------------------


def test_a_start_away_from_the_arm_is_refused_with_figures() -> None:
    bench = Bench()
    far = START.copy()
    far[2] -= 0.06
    with pytest.raises(CommandRejectedError, match=r"starts 0\.060 rad from joint3 .* allowed is 0\.05"):
        bench.servo.stream(move(start=far))
    bench.run(0.1)
    assert bench.mode is HOLDING


def test_a_start_a_little_off_is_blended_in_without_a_jump() -> None:
    bench = Bench()
    near = START.copy()
    near[0] += 0.04
    bench.servo.stream(move(start=near))
    bench.run(2.0)
    q = bench.commanded()[:, ARM]
    assert np.abs(np.diff(q, axis=0)).max() < 0.004
    acceleration = np.diff(q, n=2, axis=0) / CONTROL_PERIOD_S**2
    assert (np.abs(acceleration) <= 2.2 * DDQ_MAX[ARM]).all()
    assert bench.servo.status().finished
    assert q[-1] == pytest.approx((near + STEP)[ARM])


def test_a_point_beyond_a_joint_limit_is_refused_with_figures() -> None:
    step = STEP.copy()
    step[4] = 1.5
    with pytest.raises(CommandRejectedError, match=r"joint5 at 1\.\d+ rad .* -1\.3439 to 1\.3439"):
        Bench().servo.stream(move(step=step))


def test_too_much_speed_is_refused_with_figures() -> None:
    with pytest.raises(CommandRejectedError, match=r"joint1 at .* rad/s; allowed is 3\.14"):
        Bench().servo.stream(move(duration_s=0.4))


def test_steps_that_imply_too_much_speed_are_refused() -> None:
    q = np.vstack([START, START + 0.04])
    chunk = TrajectoryChunk(trajectory_id=1, t_s=np.array([0.0, 0.01]), q=q, dq=np.zeros((2, 7)))
    with pytest.raises(CommandRejectedError, match=r"at 4\.000 rad/s"):
        Bench().servo.stream(chunk)


@pytest.mark.parametrize("from_s", [0.46, 0.2])
def test_a_gap_or_an_overlap_in_time_is_refused(from_s: float) -> None:
    bench = Bench()
    bench.servo.stream(move(until_s=0.4))
    with pytest.raises(CommandRejectedError, match=r"starts at .* but 0\.4000 s is buffered"):
        bench.servo.stream(move(from_s=from_s))


def test_a_first_chunk_that_does_not_start_at_zero_is_refused() -> None:
    with pytest.raises(CommandRejectedError, match="first chunk starts at 0"):
        Bench().servo.stream(move(from_s=0.02))


def test_more_after_the_final_chunk_is_refused() -> None:
    bench = Bench()
    bench.servo.stream(move())
    with pytest.raises(CommandRejectedError, match="has had its final chunk"):
        bench.servo.stream(move(from_s=0.98))


def test_more_than_can_be_checked_in_time_for_a_stop_is_refused() -> None:
    long = np.arange(MAX_POINTS + 1) * CONTROL_PERIOD_S
    still = np.tile(START, (len(long), 1))
    bench = Bench()
    with pytest.raises(CommandRejectedError, match=r"10001 points buffered; allowed are 10000.*in pieces"):
        bench.servo.stream(TrajectoryChunk(trajectory_id=1, t_s=long, q=still, dq=0 * still))
    bench.servo.stream(TrajectoryChunk(trajectory_id=1, t_s=long[:-1], q=still[:-1], dq=0 * still[:-1]))


def test_a_stale_trajectory_is_refused() -> None:
    bench = Bench()
    bench.servo.stream(move(5))
    with pytest.raises(CommandRejectedError, match="next one is 6 or more"):
        bench.servo.stream(move(4))


def test_what_is_no_chunk_and_no_setpoint_is_refused() -> None:
    bench = Bench()
    with pytest.raises(CommandRejectedError, match="TrajectoryChunk, not a list"):
        bench.servo.stream([1, 2, 3])  # type: ignore[arg-type]
    with pytest.raises(CommandRejectedError, match="ArmSetpoint, not a str"):
        bench.servo.send("up")  # type: ignore[arg-type]


def test_a_setpoint_while_a_trajectory_plays_is_refused() -> None:
    bench = Bench()
    bench.servo.stream(move())
    with pytest.raises(CommandRejectedError, match="trajectory 1 is playing"):
        bench.servo.send(setpoint(START))


def test_nothing_works_before_connect() -> None:
    bench = Bench()
    bench.servo.disconnect()
    for use in (
        bench.servo.tick,
        bench.servo.status,
        lambda: bench.servo.claim("x"),
        lambda: bench.servo.stream(move()),
    ):
        with pytest.raises(NotConnectedError):
            use()


def test_a_refused_chunk_leaves_the_running_trajectory_alone() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(0.5)
    with pytest.raises(CommandRejectedError):
        bench.servo.stream(move(2))
    bench.run(0.6)
    assert bench.servo.status().finished


# --- Lease ----------------------------------------------------------------------------------------------------------


def test_only_the_owner_commands() -> None:
    bench = Bench()
    with pytest.raises(LeaseError, match="'test'"):
        bench.servo.claim("another")
    with pytest.raises(LeaseError, match="'test', not by 'another'"):
        bench.servo.stream(move(), owner="another")
    with pytest.raises(LeaseError, match="'test', not by 'another'"):
        bench.servo.heartbeat("another")
    bench.servo.release("another")
    assert bench.servo.status().owner == "test"
    bench.servo.claim("test")
    bench.servo.stream(move(), owner="test")


def test_nobody_commands_without_a_lease() -> None:
    bench = Bench()
    bench.servo.release()
    for command in (lambda: bench.servo.stream(move()), lambda: bench.servo.send(setpoint(START))):
        with pytest.raises(LeaseError, match="claim"):
            command()


def test_a_silent_lease_lapses_once_nothing_moves() -> None:
    bench = Bench(heartbeat_timeout_s=0.1)
    bench.servo.stream(move())
    bench.run(0.4, bench.servo.heartbeat)
    bench.run(0.9)
    with pytest.raises(LeaseError):
        bench.servo.claim("another")
    bench.run(0.2)
    assert bench.servo.status().owner == ""
    bench.servo.claim("another")
    assert bench.servo.status().owner == "another"
    with pytest.raises(LeaseError):
        bench.servo.heartbeat("test")


def test_what_was_taken_while_the_tick_found_a_fault_is_dropped_by_the_rearming() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.servo._mailbox.latch = "a fault"  # as the tick does, which takes no lock
    bench.servo.rearm()
    bench.servo.claim("test")
    bench.run(0.2)
    assert bench.mode is HOLDING
    assert bench.commanded() == pytest.approx(np.tile(START, (len(bench.sent), 1)), abs=1e-9)


def test_an_owner_who_was_silent_is_heard_again_unless_another_took_his_place() -> None:
    bench = Bench(heartbeat_timeout_s=0.1)
    bench.run(1.1)
    assert bench.servo.status().owner == ""
    bench.servo.heartbeat("test")
    assert bench.servo.status().owner == "test"
    bench.run(1.1)
    bench.servo.claim("another")
    for late in (lambda: bench.servo.heartbeat("test"), lambda: bench.servo.stream(move(), owner="test")):
        with pytest.raises(LeaseError, match="'another', not by 'test'"):
            late()
    bench.servo.stream(move(), owner="another")
    bench.run(1.1, lambda: bench.servo.heartbeat("another"))
    assert bench.servo.status().finished
