"""The driver against a controller that reads one datagram a cycle, on a stepped clock."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig, Z1Mode
from hal.backends.z1.requests import RequestPhase
from hal.base import z1
from hal.base.clock import ManualClock
from hal.base.errors import CommandRejectedError, HalTimeoutError
from hal.base.messages import ArmSetpoint, ServoMode, TrajectoryChunk
from hal.bus.health import describe_health
from hal.servo.servo import Servo
from hal.z1_protocol.controller import LABELS, TrajectoryCommand, encode_command
from hal.z1_protocol.states import Fsm
from tests.support.errors import raises
from tests.support.hal.vendor_controller import CYCLE_S, VendorController, VendorLink
from z1_runtime.motion.limits import MotionLimits
from z1_runtime.motion.trajectory import joint_move

REST = np.zeros(z1.N_JOINTS)
PERIOD_S = z1.CONTROL_PERIOD_S


class Bench(NamedTuple):
    arm: Z1Arm
    peer: VendorController
    link: VendorLink
    clock: ManualClock

    def run(self, q: np.ndarray, duration_s: float) -> None:
        for _ in range(round(duration_s / PERIOD_S)):
            self.arm.read_state()
            self.arm.send(ArmSetpoint(q=q, dq=REST))
            self.clock.advance(PERIOD_S)


def make_bench(mode: Z1Mode = Z1Mode.TRACKING) -> Bench:
    clock = ManualClock(10.0)
    peer = VendorController(10.0)
    link = VendorLink(peer, clock)
    return Bench(Z1Arm(clock, Z1ArmConfig(mode=mode), link=link), peer, link, clock)


def settle(bench: Bench, duration_s: float = 0.15) -> float:
    """Return the maximum deviation of a joint [rad] from now on, for `duration_s` [s]."""
    before, worst = bench.peer.q.copy(), 0.0
    for _ in range(round(duration_s / PERIOD_S)):
        bench.clock.advance(PERIOD_S)
        bench.peer.advance(bench.clock.now_s())
        worst = max(worst, float(np.abs(bench.peer.q - before).max()))
    return worst


@pytest.mark.parametrize("leave", ["tracking", "disconnect", "back to start", "passive"])
def test_no_way_out_of_low_level_jerks_the_arm(leave: str) -> None:
    bench = make_bench(Z1Mode.LOW_LEVEL)
    bench.arm.connect()
    bench.run(bench.peer.q.copy(), 0.1)
    before = bench.peer.q.copy()
    first = len(bench.peer.received)
    match leave:
        case "tracking":
            bench.arm.enter(Z1Mode.TRACKING)
        case "disconnect":
            bench.arm.disconnect()
        case "passive":
            bench.arm.go_passive()
        case "back to start":
            bench.arm.begin_move(Fsm.BACKTOSTART)
    requests = [c for c in bench.peer.received[first:] if c.state is not Fsm.INVALID]
    assert requests
    for request in requests:
        assert request.joints().q[:6] == pytest.approx(before[:6], abs=0.01)
        assert (request.joints().kp > 0).all()
    if leave in ("tracking", "disconnect"):
        assert bench.peer.fsm is Fsm.JOINTCTRL
        assert np.abs(bench.peer.q - before).max() + settle(bench) < 0.02


@pytest.mark.integration
def test_a_stream_of_setpoints_builds_no_backlog() -> None:
    bench = make_bench()
    bench.arm.connect()
    bench.run(bench.peer.q.copy(), 6.0)
    assert len(bench.peer.queue) <= 2
    assert bench.peer.dropped == 0
    assert len(bench.peer.read) > 0.9 * 6.0 / PERIOD_S


@pytest.mark.integration
def test_the_command_latency_is_measured_and_the_newest_setpoint_is_sent() -> None:
    bench = make_bench()
    bench.arm.connect()
    goal = bench.peer.q.copy()
    for _ in range(500):
        goal[0] += 2e-4
        bench.run(goal, PERIOD_S)
    latency = bench.arm.command_latency()
    # From one cycle to two and the tick that looks
    assert 1e3 * CYCLE_S <= latency.p50_ms <= latency.p99_ms <= 3 * 1e3 * CYCLE_S + 1e3 * PERIOD_S
    newest = [c.joints().q[0] for c in bench.peer.received if c.track][-1]
    assert newest == pytest.approx(goal[0], abs=3 * 2e-4)


def test_commands_that_arrive_late_latch_the_servo() -> None:
    bench = make_bench()
    servo = Servo(bench.arm, bench.clock)
    servo.connect()
    for _ in range(50):
        servo.tick()
        bench.clock.advance(PERIOD_S)
    for tick in range(200):  # another program fills the controller's socket, and gets the answers to that
        for _ in range(35 if tick == 0 else 1):
            bench.peer.deliver(encode_command(Fsm.INVALID))
            bench.peer.answered_elsewhere.add(bench.peer.delivered)
        servo.tick()
        bench.clock.advance(PERIOD_S)
    assert servo.status().mode is ServoMode.STOPPED
    assert "late" in servo.status().reason


def test_lost_commands_do_not_end_the_stream() -> None:
    bench = make_bench()
    bench.arm.connect()
    first = bench.link.sent
    bench.link.lost = {first + 50, first + 51, first + 120}
    bench.run(bench.peer.q.copy(), 1.0)
    counts = bench.arm.diagnostics().counts
    assert counts.sent > first + 0.4 / PERIOD_S
    assert len(bench.peer.queue) <= 2


def test_a_controller_that_is_busy_finds_no_backlog_afterwards() -> None:
    bench = make_bench()
    bench.arm.connect()
    bench.run(bench.peer.q.copy(), 0.1)
    bench.peer.blocked_until_s = bench.clock.now_s() + 0.09
    bench.run(bench.peer.q.copy(), 0.4)
    assert len(bench.peer.queue) <= 2
    assert bench.arm.command_latency().max_ms > 80


# --- Requests -----------------------------------------------------------------------------------------------------


def test_a_late_request_is_not_reported_as_refused() -> None:
    bench = make_bench()
    bench.arm.connect()
    bench.peer.blocked_until_s = bench.clock.now_s() + 0.6  # longer than the time in which it is read otherwise
    bench.arm.begin_move(Fsm.TOSTATE, "forward")
    assert bench.arm.diagnostics().request.phase is RequestPhase.DONE
    assert bench.peer.fsm is Fsm.TOSTATE


def test_a_request_that_is_never_read_is_retracted_and_not_called_refused() -> None:
    bench = make_bench()
    bench.arm.connect()
    bench.peer.blocked_until_s = bench.clock.now_s() + 3.0
    with raises(HalTimeoutError, "request_unread"):
        bench.arm.begin_move(Fsm.TOSTATE, "forward")
    assert bench.arm.diagnostics().request.phase is RequestPhase.RETRACTED
    before = bench.peer.q.copy()
    bench.clock.advance(1.0)
    assert settle(bench, 2.0) < 0.05
    assert np.abs(bench.peer.q - before).max() < 0.05
    assert bench.peer.fsm is Fsm.JOINTCTRL


def test_a_stop_retracts_a_request_that_the_controller_has_not_read_yet() -> None:
    bench = make_bench()
    bench.arm.connect()
    bench.peer.blocked_until_s = bench.clock.now_s() + 0.3
    before = bench.peer.q.copy()
    bench.arm._client.cancelled = True  # what `stop` sets first, in another thread
    with raises(CommandRejectedError, "cancelled"):
        bench.arm.begin_move(Fsm.TOSTATE, "forward")
    bench.arm.stop()
    bench.clock.advance(0.5)
    assert settle(bench, 1.0) < 0.02
    assert np.abs(bench.peer.q - before).max() < 0.02


@pytest.mark.parametrize("label", ["nowhere", "my label"])
def test_a_label_that_shows_for_one_cycle_is_refused(label: str) -> None:
    bench = make_bench()
    bench.arm.connect()
    with raises(CommandRejectedError, "request_refused"):
        bench.arm.run_label(label)
    assert bench.arm.diagnostics().request.phase is RequestPhase.REFUSED
    bench.arm.run_label("forward")
    assert bench.peer.q[:6] == pytest.approx(LABELS["forward"], abs=0.01)


def test_a_pose_that_is_saved_within_one_cycle_is_done() -> None:
    bench = make_bench()
    bench.arm.connect()
    bench.arm.begin_move(Fsm.SAVESTATE, "here")
    bench.arm.end_move()
    assert bench.arm.diagnostics().request.phase is RequestPhase.DONE


@pytest.mark.parametrize("bend_m", [0.0, 0.001, 0.05])
def test_an_arc_on_a_line_is_rejected_before_it_is_asked(bend_m: float) -> None:
    bench = make_bench()
    bench.arm.connect()
    pose = bench.arm.newest.pose
    poses = np.stack([pose, pose])
    poses[0, 3] += 0.03
    poses[0, 5] += bend_m
    poses[1, 3] += 0.06
    asked = bench.peer.delivered
    move = TrajectoryCommand(poses=poses, max_speed=0.1, gripper_rad=float(bench.peer.q[6]))
    if bend_m < 0.002:
        with raises(CommandRejectedError, "arc_on_line"):
            bench.arm.begin_move(Fsm.MOVEC, move)
        assert bench.peer.delivered == asked
    else:
        bench.arm.begin_move(Fsm.MOVEC, move)


def test_back_to_start_out_of_low_level_ends_in_tracking() -> None:
    bench = make_bench(Z1Mode.LOW_LEVEL)
    bench.arm.connect()
    bench.arm.back_to_start()
    assert bench.arm.mode is Z1Mode.TRACKING
    assert bench.peer.q == pytest.approx(np.append(LABELS["startFlat"], 0.0), abs=0.01)


# --- Silence ------------------------------------------------------------------------------------------------------


def test_the_error_after_a_pause_of_this_process_names_the_pause() -> None:
    bench = make_bench()
    bench.arm.connect()
    bench.run(bench.peer.q.copy(), 0.1)
    bench.clock.advance(5.0)
    bench.peer.advance(bench.clock.now_s())
    assert bench.peer.fsm is Fsm.PASSIVE
    with raises(CommandRejectedError, "controller_left_state") as caught:
        bench.run(bench.peer.q.copy(), 0.1)
    assert "this process sent nothing for 5." in str(caught.value)
    assert "sent nothing for 5." in bench.arm.read_state().faults[0]


def test_nothing_is_loaded_while_the_arm_sinks(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = make_bench()
    bench.arm.connect()
    states: list[Fsm] = []
    load = bench.arm._commands.prepare
    monkeypatch.setattr(bench.arm._commands, "prepare", lambda mode: (states.append(bench.peer.fsm), load(mode)))
    bench.arm.enter(Z1Mode.LOW_LEVEL)
    assert states[0] is Fsm.JOINTCTRL


def test_a_grip_survives_every_change_of_mode() -> None:
    bench = make_bench(Z1Mode.LOW_LEVEL)
    bench.arm.connect()
    bench.peer.stuck = 6
    bench.arm.grip(2.0)
    bench.run(bench.peer.q.copy(), 0.1)
    bench.arm.enter(Z1Mode.TRACKING)
    lead = bench.peer.received[-1].joints().q[6] - bench.peer.q[6]
    assert lead * z1.KP[6] == pytest.approx(2.0, abs=0.2)


def test_an_object_in_the_jaws_stays_there_when_a_new_driver_and_servo_take_the_arm_over() -> None:
    bench = make_bench()
    bench.peer.stuck, bench.peer.fsm = 6, Fsm.JOINTCTRL
    bench.peer.target[6] += 2.0 / z1.KP[6]  # as the driver before commanded it
    servo = Servo(bench.arm, bench.clock)
    servo.connect()
    for _ in range(200):
        servo.tick()
        bench.clock.advance(PERIOD_S)
        lead = bench.peer.target[6] - bench.peer.q[6]
        assert lead * z1.KP[6] == pytest.approx(2.0, abs=0.2)


def test_the_latency_is_part_of_the_servos_health() -> None:
    bench = make_bench()
    servo = Servo(bench.arm, bench.clock)
    servo.connect()
    for _ in range(100):
        servo.tick()
        bench.clock.advance(PERIOD_S)
    health = servo.health()
    assert 0.0 < health.command_latency_ms_p50 <= health.command_latency_ms_p99 <= health.command_latency_ms_max
    assert "command latency p50" in describe_health(health)


@pytest.mark.parametrize("opening_rad", [-0.5, 0.2])
@pytest.mark.parametrize("torque_nm", [2.0, 0.5, -0.4])
@pytest.mark.parametrize("speed", [0.05, 1.0])
def test_a_kept_grip_ends_when_a_motion_moves_the_jaw(opening_rad: float, torque_nm: float, speed: float) -> None:
    bench = make_bench()
    bench.peer.stuck, bench.peer.fsm = 6, Fsm.JOINTCTRL
    bench.peer.q[6] = -0.6
    bench.peer.target[6] = -0.6 + torque_nm / z1.KP[6]
    servo = Servo(bench.arm, bench.clock)
    servo.connect()
    servo.claim("test")
    servo.tick()
    bench.peer.stuck = None
    start = servo.status().q_command
    goal = start.copy()
    goal[6] += opening_rad
    move = joint_move(start, goal, MotionLimits.at_speed(speed))
    servo.stream(TrajectoryChunk(trajectory_id=1, t_s=move.t_s, q=move.q, dq=move.dq, final=True))
    for _ in range(round(move.duration_s / PERIOD_S) + 200):
        servo.tick()
        bench.clock.advance(PERIOD_S)
    assert bench.peer.q[6] == pytest.approx(goal[6], abs=0.03)
