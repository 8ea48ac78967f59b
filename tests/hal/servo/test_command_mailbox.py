"""Commands of producers: the lease, and the rejections with their codes."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base.errors import CommandRejectedError, LeaseError, NotConnectedError
from hal.base.messages import ServoMode, TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S, DDQ_MAX
from hal.servo.trajectory_buffer import MAX_POINTS
from tests.support.errors import raises
from tests.support.hal.servo_bench import ARM, START, STEP, Bench, move, setpoint

HOLDING = ServoMode.HOLDING


# --- Rejections -----------------------------------------------------------------------------------------------------


def test_a_start_away_from_the_arm_is_rejected_with_value_range_and_remedy() -> None:
    bench = Bench()
    far = START.copy()
    far[2] -= 0.06
    with raises(CommandRejectedError, "start_jump") as caught:
        bench.servo.stream(move(start=far))
    for part in ("0.060 rad from joint3", "allowed 0.05 rad", "Plan again"):
        assert part in str(caught.value)
    bench.run(0.1)
    assert bench.mode is HOLDING


@pytest.mark.integration
def test_a_start_within_the_tolerance_is_blended_in_without_a_jump() -> None:
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


def test_a_point_beyond_a_joint_limit_is_rejected() -> None:
    step = STEP.copy()
    step[4] = 1.5
    with raises(CommandRejectedError, "joint_limit"):
        Bench().servo.stream(move(step=step))


def test_too_much_speed_is_rejected() -> None:
    with raises(CommandRejectedError, "speed_limit"):
        Bench().servo.stream(move(duration_s=0.4))


def test_steps_that_imply_too_much_speed_are_rejected() -> None:
    q = np.vstack([START, START + 0.04])
    chunk = TrajectoryChunk(trajectory_id=1, t_s=np.array([0.0, 0.01]), q=q, dq=np.zeros((2, 7)))
    with raises(CommandRejectedError, "speed_limit"):
        Bench().servo.stream(chunk)


@pytest.mark.parametrize("from_s", [0.46, 0.2])
def test_a_gap_or_an_overlap_in_time_is_rejected(from_s: float) -> None:
    bench = Bench()
    bench.servo.stream(move(until_s=0.4))
    with raises(CommandRejectedError, "chunk_gap"):
        bench.servo.stream(move(from_s=from_s))


def test_a_first_chunk_that_does_not_start_at_zero_is_rejected() -> None:
    with raises(CommandRejectedError, "first_chunk_time"):
        Bench().servo.stream(move(from_s=0.02))


def test_a_chunk_after_the_final_one_is_rejected() -> None:
    bench = Bench()
    bench.servo.stream(move())
    with raises(CommandRejectedError, "trajectory_complete"):
        bench.servo.stream(move(from_s=0.98))


def test_more_points_than_can_be_checked_in_time_for_a_stop_are_rejected() -> None:
    long = np.arange(MAX_POINTS + 1) * CONTROL_PERIOD_S
    still = np.tile(START, (len(long), 1))
    bench = Bench()
    with raises(CommandRejectedError, "buffer_full"):
        bench.servo.stream(TrajectoryChunk(trajectory_id=1, t_s=long, q=still, dq=0 * still))
    bench.servo.stream(TrajectoryChunk(trajectory_id=1, t_s=long[:-1], q=still[:-1], dq=0 * still[:-1]))


def test_a_stale_trajectory_is_rejected() -> None:
    bench = Bench()
    bench.servo.stream(move(5))
    with raises(CommandRejectedError, "stale_trajectory"):
        bench.servo.stream(move(4))


def test_objects_of_another_type_are_rejected() -> None:
    bench = Bench()
    with raises(CommandRejectedError, "wrong_type"):
        bench.servo.stream([1, 2, 3])  # type: ignore[arg-type]
    with raises(CommandRejectedError, "wrong_type"):
        bench.servo.send("up")  # type: ignore[arg-type]


def test_a_setpoint_while_a_trajectory_plays_is_rejected() -> None:
    bench = Bench()
    bench.servo.stream(move())
    with raises(CommandRejectedError, "trajectory_active"):
        bench.servo.send(setpoint(START))


def test_every_call_before_connect_raises() -> None:
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


def test_a_rejected_chunk_leaves_the_running_trajectory_alone() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(0.5)
    with raises(CommandRejectedError, "start_jump"):
        bench.servo.stream(move(2))
    bench.run(0.6)
    assert bench.servo.status().finished


# --- Lease ----------------------------------------------------------------------------------------------------------


def test_only_the_owner_commands() -> None:
    bench = Bench()
    with raises(LeaseError, "owned_by_other") as caught:
        bench.servo.claim("another")
    assert "'test'" in str(caught.value)
    with raises(LeaseError, "owned_by_other"):
        bench.servo.stream(move(), owner="another")
    with raises(LeaseError, "owned_by_other"):
        bench.servo.heartbeat("another")
    bench.servo.release("another")
    assert bench.servo.status().owner == "test"
    bench.servo.claim("test")
    bench.servo.stream(move(), owner="test")


def test_rearm_needs_the_lease_as_a_command_does() -> None:
    bench = Bench()
    bench.servo.stop("inspect it")
    bench.run(0.1)
    with raises(LeaseError, "owned_by_other"):
        bench.servo.rearm("another")
    assert bench.mode is ServoMode.STOPPED
    bench.servo.rearm("test")
    bench.run(0.1)
    assert bench.mode is HOLDING
    assert bench.servo.status().owner == ""
    with raises(LeaseError, "not_claimed"):
        bench.servo.rearm("test")


def test_while_the_stop_is_latched_another_client_can_claim_the_lease_and_rearm() -> None:
    bench = Bench()
    bench.servo.stop("inspect it")
    bench.run(0.1)
    bench.servo.claim("another")
    with raises(LeaseError, "owned_by_other"):
        bench.servo.rearm("test")
    bench.servo.rearm("another")
    bench.run(0.1)
    assert bench.mode is HOLDING


def test_a_command_without_a_lease_is_rejected() -> None:
    bench = Bench()
    bench.servo.release()
    for command in (lambda: bench.servo.stream(move()), lambda: bench.servo.send(setpoint(START))):
        with raises(LeaseError, "not_claimed"):
            command()


@pytest.mark.integration
def test_a_lease_without_heartbeat_lapses_once_the_arm_is_at_rest() -> None:
    bench = Bench(heartbeat_timeout_s=0.1)
    bench.servo.stream(move())
    bench.run(0.4, bench.servo.heartbeat)
    bench.run(0.9)
    with raises(LeaseError, "owned_by_other"):
        bench.servo.claim("another")
    bench.run(0.2)
    assert bench.servo.status().owner == ""
    bench.servo.claim("another")
    assert bench.servo.status().owner == "another"
    with raises(LeaseError, "owned_by_other"):
        bench.servo.heartbeat("test")


def test_a_command_accepted_while_the_tick_found_a_fault_is_dropped_by_rearm() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.servo._mailbox.latch = "a fault"  # as the tick does, which takes no lock
    bench.servo.rearm()
    bench.servo.claim("test")
    bench.run(0.2)
    assert bench.mode is HOLDING
    assert bench.commanded() == pytest.approx(np.tile(START, (len(bench.sent), 1)), abs=1e-9)


@pytest.mark.integration
def test_a_lapsed_lease_is_revived_by_its_owner_unless_another_client_claimed_it() -> None:
    bench = Bench(heartbeat_timeout_s=0.1)
    bench.run(1.1)
    assert bench.servo.status().owner == ""
    bench.servo.heartbeat("test")
    assert bench.servo.status().owner == "test"
    bench.run(1.1)
    bench.servo.claim("another")
    for late in (lambda: bench.servo.heartbeat("test"), lambda: bench.servo.stream(move(), owner="test")):
        with raises(LeaseError, "owned_by_other"):
            late()
    bench.servo.stream(move(), owner="another")
    bench.run(1.1, lambda: bench.servo.heartbeat("another"))
    assert bench.servo.status().finished
