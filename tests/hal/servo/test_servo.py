"""The servo over a mock arm, with every fault that it has to handle."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
import pytest

from hal.base.arm import ServoedArm
from hal.base.errors import CommandRejectedError, HalTimeoutError, LeaseError, StoppedError
from hal.base.messages import ServoMode, TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S, DDDQ_MAX, DDQ_MAX, DQ_MAX, KP, N_ARM, N_JOINTS, Q_MAX, Q_MIN, TAU_MAX
from hal.servo.limits import ServoLimits
from tests.support.errors import raises
from tests.support.hal.servo_bench import ARM, RAMP_S, START, STEP, Bench, cruise, move, setpoint

HOLDING, TRACKING, BRAKING, STOPPED = ServoMode.HOLDING, ServoMode.TRACKING, ServoMode.BRAKING, ServoMode.STOPPED


def test_a_servo_satisfies_the_contract() -> None:
    assert isinstance(Bench().servo, ServoedArm)


def test_a_trajectory_is_played_to_its_end() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(1.1)
    status = bench.servo.status()
    assert (status.mode, status.finished, status.reason) == (HOLDING, True, "")
    assert (status.trajectory_id, status.trajectory_time_s, status.buffered_s) == (1, pytest.approx(1.0), 0.0)
    assert status.q_command[ARM] == pytest.approx((START + STEP)[ARM])
    assert bench.arm.read_state().q[ARM] == pytest.approx((START + STEP)[ARM], abs=1e-3)


def test_every_setpoint_is_on_the_trajectory() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(1.0)
    s = np.arange(500) * CONTROL_PERIOD_S
    path = START + (10 * s**3 - 15 * s**4 + 6 * s**5)[:, None] * STEP
    assert bench.commanded()[1:501, ARM] == pytest.approx(path[:, ARM], abs=1e-5)


@pytest.mark.integration
def test_chunks_are_joined_without_a_seam() -> None:
    whole, pieces = Bench(), Bench()
    whole.servo.stream(move())
    whole.run(1.1)
    pieces.servo.stream(move(until_s=0.3))
    pieces.run(0.1)
    pieces.servo.stream(move(from_s=0.3, until_s=0.6))
    pieces.run(0.3)
    pieces.servo.stream(move(from_s=0.6))
    pieces.run(0.7)
    assert pieces.servo.status().finished
    assert pieces.commanded() == pytest.approx(whole.commanded(), abs=1e-9)


def test_the_buffered_time_is_reported() -> None:
    bench = Bench()
    bench.servo.stream(move(until_s=0.3))
    assert bench.servo.status().buffered_s == pytest.approx(0.3)
    bench.run(0.102)
    assert bench.servo.status().buffered_s == pytest.approx(0.2)


def test_a_late_tick_holds_the_trajectory_time_and_is_counted() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(0.5)
    before = bench.servo.status()
    bench.clock.advance(0.05)
    bench.run(CONTROL_PERIOD_S)
    after = bench.servo.status()
    assert after.trajectory_time_s - before.trajectory_time_s == pytest.approx(CONTROL_PERIOD_S)
    assert after.overruns - before.overruns == 1
    bench.run(1.0)
    assert bench.servo.status().finished
    assert bench.servo.status().overruns == after.overruns


# --- Loss of the sender --------------------------------------------------------------------------------------------


def test_before_a_buffer_is_empty_the_arm_brakes_on_its_path_and_holds() -> None:
    bench = Bench()
    bench.servo.stream(move(until_s=0.4))
    bench.run(0.36)
    assert bench.mode is BRAKING
    assert bench.servo.status().buffered_s == 0.0
    bench.run_until_at_rest()
    status = bench.servo.status()
    assert status.mode is HOLDING
    assert not status.finished
    assert "buffer underrun at 0.400 s" in status.reason
    buffered = move(until_s=0.4).q
    assert abs(status.q_command[0] - START[0]) <= abs(buffered[-1, 0] - START[0])
    held = status.q_command
    bench.run(0.5)
    assert bench.servo.status().q_command == pytest.approx(held, abs=1e-12)


@pytest.mark.integration
def test_a_first_chunk_too_short_to_stop_on_waits_for_the_next_one_and_is_dropped_without() -> None:
    bench = Bench()
    bench.servo.stream(move(until_s=0.04))
    bench.run(0.4)
    assert (bench.mode, bench.servo.status().trajectory_time_s) == (TRACKING, 0.0)
    bench.servo.stream(move(from_s=0.04))
    bench.run(1.1)
    assert bench.servo.status().finished
    here = bench.servo.status().q_command
    bench.servo.stream(move(2, start=here, step=-0.2 * STEP, until_s=0.04))
    bench.run(0.6)
    assert bench.mode is HOLDING
    assert "buffer underrun" in bench.reason
    assert bench.servo.status().q_command == pytest.approx(here, abs=1e-9)


def test_a_dropped_trajectory_is_not_continued_but_a_new_one_is_played() -> None:
    bench = Bench()
    bench.servo.stream(move(until_s=0.4))
    bench.run(1.0)
    with raises(CommandRejectedError, "stale_trajectory") as caught:
        bench.servo.stream(move(from_s=0.4))
    assert "number 2 or above" in str(caught.value)
    bench.servo.stream(move(2, start=bench.servo.status().q_command, step=-0.2 * STEP))
    bench.run(1.2)
    assert bench.servo.status().finished
    assert bench.reason == ""


def test_a_late_heartbeat_brakes() -> None:
    bench = Bench(heartbeat_timeout_s=0.1)
    bench.servo.stream(move())
    bench.run(0.3, bench.servo.heartbeat)
    assert bench.mode is TRACKING
    bench.run(0.12)
    assert bench.mode is BRAKING
    assert "no heartbeat from 'test'" in bench.reason
    bench.run_until_at_rest()
    assert bench.mode is HOLDING
    assert not bench.servo.status().finished


def test_an_owner_in_this_process_needs_no_heartbeat() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(1.1)
    assert bench.servo.status().finished


def test_a_single_setpoint_is_tracked_and_then_held() -> None:
    bench = Bench()
    goal = START + 0.1
    bench.run(0.5, lambda: bench.servo.send(setpoint(goal)) and None)
    assert bench.servo.status().q_command[ARM] == pytest.approx(goal[ARM])
    assert bench.mode is TRACKING
    bench.run(0.5)
    assert bench.mode is HOLDING
    assert bench.servo.status().q_command[ARM] == pytest.approx(goal[ARM], abs=1e-6)


def test_a_stream_of_setpoints_that_ends_in_motion_brakes_the_arm() -> None:
    bench = Bench()
    goal = START.copy()
    goal[0] += 2.0
    bench.servo.send(setpoint(goal))
    bench.run(0.12)
    assert bench.mode is BRAKING
    bench.run_until_at_rest()
    assert bench.servo.status().q_command[0] < goal[0] - 0.5


# --- Stop ---------------------------------------------------------------------------------------------------------


def test_a_stop_brakes_at_the_next_tick_and_latches() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(0.5)
    bench.servo.stop("the button")
    with raises(StoppedError, "stopped") as caught:
        bench.servo.stream(move(2))
    for part in ("the button", "`./z1 rearm`"):
        assert part in str(caught.value)
    bench.run(CONTROL_PERIOD_S)
    assert bench.mode is BRAKING
    assert bench.run_until_at_rest() < 0.4
    assert (bench.mode, bench.reason) == (STOPPED, "the button")
    held = bench.servo.status().q_command
    for command in (lambda: bench.servo.stream(move(2)), lambda: bench.servo.send(setpoint(START))):
        with raises(StoppedError, "stopped"):
            command()
    bench.run(0.5)
    assert bench.servo.status().q_command == pytest.approx(held, abs=1e-12)


@pytest.mark.integration
def test_rearm_clears_the_stop_and_frees_the_lease() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(0.5)
    bench.servo.stop()
    bench.run(0.5)
    bench.servo.rearm()
    bench.run(0.1)
    status = bench.servo.status()
    assert (status.mode, status.owner, status.reason) == (HOLDING, "", "")
    with raises(LeaseError, "not_claimed"):
        bench.servo.stream(move(2))
    bench.servo.claim("another")
    bench.servo.stream(move(2, start=status.q_command, step=-0.2 * STEP))
    bench.run(1.2)
    assert bench.servo.status().finished


def test_a_stop_drops_the_queue_even_when_it_is_cleared_before_the_next_tick() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(0.5)
    bench.servo.stop()
    bench.servo.rearm()
    bench.run(CONTROL_PERIOD_S)
    assert bench.mode is BRAKING
    bench.run_until_at_rest()
    assert bench.mode is HOLDING
    assert not bench.servo.status().finished


def test_a_stop_in_the_middle_of_a_tick_is_not_reported_as_rest_before_the_arm_has_braked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(0.5)
    send = bench.arm.send
    monkeypatch.setattr(bench.arm, "send", lambda setpoint: (bench.servo.stop("the button"), send(setpoint))[1])
    bench.run(CONTROL_PERIOD_S)
    monkeypatch.undo()
    assert (bench.mode, bench.reason) == (TRACKING, "the button")
    bench.run_until_at_rest()
    assert bench.mode is STOPPED


def test_a_stop_while_a_single_setpoint_is_tracked_brakes_and_latches() -> None:
    bench = Bench()
    goal = START.copy()
    goal[0] += 2.0
    bench.run(0.3, lambda: bench.servo.send(setpoint(goal)) and None)
    bench.servo.stop("the button")
    bench.run(CONTROL_PERIOD_S)
    assert bench.mode is BRAKING
    assert bench.run_until_at_rest() < 0.4
    assert (bench.mode, bench.reason) == (STOPPED, "the button")
    bench.servo.rearm()
    held = bench.servo.status().q_command
    bench.run(0.3)
    assert bench.servo.status().q_command == pytest.approx(held, abs=1e-3)


def test_a_stop_while_braking_continues_braking_and_latches() -> None:
    bench = Bench()
    bench.servo.stream(move(until_s=0.5))
    bench.run(0.55)
    assert bench.mode is BRAKING
    bench.servo.stop("the button")
    assert bench.run_until_at_rest() < 0.4
    assert (bench.mode, bench.reason) == (STOPPED, "the button")


def test_a_trajectory_stopped_before_its_first_tick_is_counted_so_that_the_next_one_is_accepted() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.servo.stop()
    bench.run(0.1)
    assert bench.servo.status().trajectory_id == 1
    assert bench.arm.read_state().q == pytest.approx(START, abs=1e-6)
    bench.servo.rearm()
    bench.servo.claim("test")
    bench.servo.stream(move(bench.servo.status().trajectory_id + 1))
    bench.run(1.1)
    assert bench.servo.status().finished


def test_a_stop_at_rest_moves_nothing() -> None:
    bench = Bench()
    bench.run(0.1)
    bench.servo.stop()
    bench.run(0.2)
    assert bench.mode is STOPPED
    assert bench.commanded() == pytest.approx(np.tile(START, (len(bench.sent), 1)), abs=1e-9)


def test_releasing_the_lease_in_motion_brakes() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(0.5)
    bench.servo.release()
    bench.run(CONTROL_PERIOD_S)
    assert bench.mode is BRAKING
    assert "released" in bench.reason
    bench.run_until_at_rest()
    assert bench.servo.status().owner == ""


# --- Braking ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("joint", range(N_ARM))
def test_braking_from_full_speed_takes_less_than_0_4_s(joint: int) -> None:
    bench = Bench()
    bench.servo.stream(cruise(joint, [1, 1, -1, 1, 1, -1][joint] * 0.99 * DQ_MAX[joint], RAMP_S + 0.05))
    bench.run(RAMP_S + 0.05 + 2 * CONTROL_PERIOD_S)
    assert bench.mode is BRAKING
    assert bench.run_until_at_rest(0.4) < 0.4
    q = bench.commanded()
    assert (q >= Q_MIN - 1e-9).all()
    assert (q <= Q_MAX + 1e-9).all()


def test_braking_stays_within_speed_acceleration_and_jerk() -> None:
    bench = Bench()
    bench.servo.stream(move(step=0.6 * STEP, until_s=0.5))
    bench.run(0.498)
    begin = len(bench.sent)
    bench.run(0.5)
    assert "buffer underrun" in bench.reason
    q = bench.commanded()[begin - 3 :, ARM]
    speed = np.diff(q, axis=0) / CONTROL_PERIOD_S
    acceleration = np.diff(speed, axis=0) / CONTROL_PERIOD_S
    jerk = np.diff(acceleration, axis=0) / CONTROL_PERIOD_S
    assert (np.abs(speed) <= DQ_MAX[ARM]).all()
    # Slower than full speed, it hardly takes more than the motion itself.
    assert (np.abs(acceleration) <= 1.5 * DDQ_MAX[ARM]).all()
    assert (np.abs(jerk) <= 4.0 * DDDQ_MAX[ARM]).all()


# --- Replacement ----------------------------------------------------------------------------------------------------


@pytest.mark.integration
def test_a_trajectory_replaced_in_motion_stops_on_its_path_and_the_new_one_begins_at_its_start() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(0.5)
    here = bench.servo.status().q_command
    back = np.zeros(N_JOINTS)
    back[0] = -0.3
    bench.servo.stream(move(2, start=here, step=back))
    begin = len(bench.sent)
    bench.run(2.5)
    q = bench.commanded()[begin - 3 :, ARM]
    acceleration = np.diff(q, n=2, axis=0) / CONTROL_PERIOD_S**2
    assert (np.abs(acceleration) <= bench.servo.limits.brake_ddq_max[ARM]).all()
    stopped = q[: round(0.24 / CONTROL_PERIOD_S)] - START[ARM]
    along = STEP[ARM] / np.linalg.norm(STEP[ARM])
    assert stopped == pytest.approx(np.outer(stopped @ along, along), abs=1e-6)
    status = bench.servo.status()
    assert (status.trajectory_id, status.finished) == (2, True)
    assert status.q_command[ARM] == pytest.approx((here + back)[ARM], abs=1e-6)


@pytest.mark.parametrize("final", [True, False])
def test_a_trajectory_that_starts_in_motion_is_rejected(final: bool) -> None:
    whole, bench = move(), Bench()
    late = TrajectoryChunk(
        trajectory_id=1, t_s=whole.t_s[:-20], q=START + whole.q[20:] - whole.q[20], dq=whole.dq[20:], final=final
    )
    with raises(CommandRejectedError, "starts_in_motion"):
        bench.servo.stream(late)


def test_a_final_chunk_that_ends_in_motion_is_rejected_and_the_arm_brakes_on_what_it_has() -> None:
    bench, whole = Bench(), move()
    bench.servo.stream(move(until_s=0.4))
    bench.run(0.2)
    cut = move(from_s=0.4, until_s=0.6)
    with raises(CommandRejectedError, "ends_in_motion"):
        bench.servo.stream(TrajectoryChunk(trajectory_id=1, t_s=cut.t_s, q=cut.q, dq=cut.dq, final=True))
    bench.run(0.5)
    assert bench.mode is HOLDING
    assert bench.servo.status().q_command[0] <= whole.q[round(0.4 / 0.02), 0] + 1e-6


def test_a_trajectory_replaces_a_single_setpoint_for_good() -> None:
    bench = Bench()
    goal = START.copy()
    goal[0] += 0.04
    bench.servo.send(setpoint(goal))
    bench.run(0.01)
    here = bench.servo.status().q_command
    still = TrajectoryChunk(
        trajectory_id=1, t_s=np.array([0.0, 0.04]), q=np.array([here, here]), dq=np.zeros((2, 7)), final=True
    )
    bench.servo.stream(still)
    bench.run(0.5)
    assert bench.servo.status().finished
    assert bench.servo.status().q_command == pytest.approx(here, abs=1e-6)


# --- Faults ---------------------------------------------------------------------------------------------------------


def test_a_fault_of_the_arm_brakes_and_latches() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(0.5)
    bench.arm.inject_fault("overheat joint 2")
    bench.run(CONTROL_PERIOD_S)
    assert bench.mode is BRAKING
    bench.run_until_at_rest()
    assert (bench.mode, bench.reason) == (STOPPED, "the arm reports overheat joint 2")
    bench.servo.rearm()
    bench.run(0.01)
    assert bench.mode is STOPPED, "the fault is still present"
    bench.arm.inject_fault()
    bench.servo.rearm()
    bench.run(0.01)
    assert bench.mode is HOLDING


def block_joint1(bench: Bench) -> None:
    bench.run(0.2)
    bench.arm.block(0)


def drop_commands(bench: Bench) -> None:
    bench.arm.drop_commands = True


@pytest.mark.integration
@pytest.mark.parametrize(
    ("inject", "limits", "reason"),
    [
        (block_joint1, None, "joint1 has been at its torque limit"),
        (drop_commands, None, "joint1 does not follow: its command has asked for"),
        (drop_commands, ServoLimits(tau_max=np.full(N_JOINTS, 1e4)), "from its command (allowed 0.30)"),
    ],
    ids=["blocked joint", "lost commands", "following error"],
)
def test_an_arm_that_does_not_follow_latches_the_stop_and_yields(
    inject: Callable[[Bench], None], limits: ServoLimits | None, reason: str
) -> None:
    bench = Bench(limits=limits)
    bench.servo.stream(move())
    inject(bench)
    bench.run(1.5)
    assert bench.mode is STOPPED
    assert reason in bench.reason
    torque = KP * (bench.servo.status().q_command - bench.arm.read_state().q)
    assert abs(torque[0]) < 0.1 * TAU_MAX[0], "at rest the command has yielded to the measurement"


@pytest.mark.integration
def test_an_arm_blocked_while_it_brakes_for_a_stop_yields_too_and_only_once() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(0.5)
    bench.servo.stop("the button")
    bench.arm.block(0)
    bench.run(1.5)
    assert (bench.mode, bench.reason) == (STOPPED, "the button")
    blocked_at = bench.arm.read_state().q
    assert bench.servo.status().q_command[0] == pytest.approx(blocked_at[0], abs=1e-3)
    bench.arm.block(None)
    bench.arm.offset[0] = -0.06  # 38 Nm: a permanent load must not drag the command along
    bench.run(1.0)
    assert bench.servo.status().q_command[0] == pytest.approx(blocked_at[0], abs=1e-3)


def test_a_motor_at_its_torque_limit_for_long_latches() -> None:
    bench = Bench()
    bench.arm.offset[1] = 0.12  # less than a following error, but more than 60 Nm
    bench.run(0.08)
    assert bench.mode is HOLDING
    bench.run(0.2)
    assert bench.mode is STOPPED
    assert "joint2 has been at its torque limit" in bench.reason


def test_an_arm_without_measurements_is_braked_open_loop_and_latched() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(0.5)
    bench.arm.freeze()
    bench.run(0.11)
    assert bench.mode is BRAKING
    assert "state is lost" in bench.reason
    bench.run_until_at_rest()
    assert bench.mode is STOPPED
    with pytest.raises(HalTimeoutError):
        bench.servo.read_state()
    bench.arm.thaw()
    bench.servo.rearm()
    bench.run(0.5)
    assert bench.mode is HOLDING


@pytest.mark.integration
def test_an_arm_that_rejects_commands_is_latched_and_gets_no_more() -> None:
    bench = Bench()
    bench.servo.stream(move())
    bench.run(0.5)
    bench.arm.reject_commands = True
    bench.run(1.0)
    assert bench.mode is STOPPED
    assert "takes no commands" in bench.reason
    bench.arm.reject_commands = False
    stuck = bench.servo.status().q_command
    bench.run(0.1)
    assert bench.servo.status().q_command == pytest.approx(stuck)
    bench.servo.rearm()
    bench.run(0.5)
    assert bench.mode is HOLDING
    assert bench.reason == ""


# --- Limits ---------------------------------------------------------------------------------------------------------


@pytest.mark.integration
def test_the_gripper_squeezes_with_a_bounded_torque_and_keeps_squeezing() -> None:
    bench = Bench()
    close = np.zeros(N_JOINTS)
    close[N_ARM] = 0.5
    bench.servo.stream(move(step=close))
    bench.run(0.3)
    bench.arm.block(N_ARM)
    bench.run(1.0)
    status = bench.servo.status()
    assert (status.mode, status.finished) == (HOLDING, True)
    tau = bench.arm.read_state().tau
    assert tau[N_ARM] == pytest.approx(3.0, rel=1e-6)
    bench.servo.stop()
    bench.run(0.5)
    assert bench.arm.read_state().tau[N_ARM] == pytest.approx(3.0, rel=1e-6)


@pytest.mark.integration
@pytest.mark.parametrize("grip", ["as desired", "as sent"])
def test_a_motion_with_a_held_object_starts_from_the_gripper_command(grip: str) -> None:
    bench = Bench()
    close = np.zeros(N_JOINTS)
    close[N_ARM] = 0.5
    bench.servo.stream(move(step=close))
    bench.run(0.3)
    bench.arm.block(N_ARM)
    bench.run(1.0)
    start = bench.servo.status().q_command.copy()
    start[N_ARM] = 0.0 if grip == "as desired" else start[N_ARM]
    lift = 0.3 * STEP
    lift[N_ARM] = 0.0
    bench.servo.stream(move(2, start=start, step=lift))
    bench.run(1.2)
    assert bench.servo.status().finished
    assert KP[N_ARM] * (bench.servo.status().q_command - bench.arm.read_state().q)[N_ARM] > 2.9


def test_a_latched_stop_and_its_end_are_logged_once_each(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench()
    with caplog.at_level(logging.INFO, logger="hal"):
        bench.arm.inject_fault("overheat joint 2")
        bench.run(0.1)
        bench.arm.inject_fault()
        bench.servo.rearm()
        bench.run(0.1)
    first, second = [record.getMessage() for record in caplog.records]
    assert first == "servo: stopped: the arm reports overheat joint 2"
    assert second == "servo: re-armed"


@pytest.mark.integration
def test_clipping_is_logged_once_an_episode_with_its_meaning(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench()
    beyond = START.copy()
    beyond[4] = Q_MAX[4] + 0.5
    with caplog.at_level(logging.WARNING, logger="hal"):
        for _ in range(2):
            bench.run(2.5, lambda: bench.servo.send(setpoint(beyond)) and None)
            bench.run(1.5)
    assert len(caplog.records) == 2
    assert "beyond its joint limits" in caplog.text


@pytest.mark.integration
@pytest.mark.parametrize("offset", [-0.0003, 0.0])
def test_an_arm_at_rest_on_a_joint_limit_is_not_clipped(offset: float, caplog: pytest.LogCaptureFixture) -> None:
    folded = np.zeros(N_JOINTS)
    folded[1] = Q_MIN[1] + offset
    bench = Bench(start=folded)
    with caplog.at_level(logging.WARNING, logger="hal"):
        bench.run(2.0)
    assert caplog.records == []
    assert bench.servo._cycle.clipped_count == 0
    lifted = np.zeros(N_JOINTS)
    lifted[1] = 0.2
    bench.servo.stream(move(start=np.zeros(N_JOINTS), step=lifted))
    bench.run(1.3)
    assert bench.servo.status().finished
    assert bench.servo._cycle.clipped_count == 0


def test_a_ticked_arm_is_read_by_the_tick_alone() -> None:
    bench = Bench()
    bench.run(0.1)
    reads: list[float] = []
    bench.arm.read_state = lambda: reads.append(1.0)  # type: ignore[method-assign, assignment]
    bench.clock.advance(0.1)
    assert bench.servo.read_state().q == pytest.approx(START)
    bench.clock.advance(0.2)
    with raises(HalTimeoutError, "stale_state") as caught:
        bench.servo.read_state()
    for part in ("0.30 s old", "allowed 0.2 s", "check the log"):
        assert part in str(caught.value)
    assert reads == []
