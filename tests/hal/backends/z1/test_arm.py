"""The real Z1's driver against a fake of the vendor's controller, in one process and one clock."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig, Z1Mode
from hal.base import z1
from hal.base.clock import ManualClock
from hal.base.errors import CommandRejectedError, HalTimeoutError, NotConnectedError
from hal.base.messages import ArmSetpoint, ServoMode, TrajectoryChunk
from hal.base.z1_kinematics import posture_from_pose
from hal.servo.limits import SPEED_TOLERANCE
from hal.servo.servo import Servo
from hal.z1_protocol.controller import COMMAND_SIZE, LABELS, STATE_SIZE, TrajectoryCommand
from hal.z1_protocol.records import MotorError, MotorLink
from hal.z1_protocol.states import Fsm
from tests.support.errors import raises
from tests.support.hal.z1_peer import FakeController, MemoryLink, mangle_at_random, pivot_kinematics

REST = np.zeros(z1.N_JOINTS)
PERIOD_S = z1.CONTROL_PERIOD_S


class Bench(NamedTuple):
    arm: Z1Arm
    peer: FakeController
    link: MemoryLink
    clock: ManualClock

    def tick(self, q: np.ndarray, dq: np.ndarray = REST) -> np.ndarray:
        """Send `q` for one control period; return the applied positions."""
        self.arm.read_state()
        applied = self.arm.send(ArmSetpoint(q=q, dq=dq)).q
        self.clock.advance(PERIOD_S)
        return applied

    def run(self, q: np.ndarray, duration_s: float) -> None:
        for _ in range(round(duration_s / PERIOD_S)):
            self.tick(q)

    def shift(self, joint: int, by: float) -> np.ndarray:
        q = self.arm.read_state().q.copy()
        q[joint] += by
        return q


def make_bench(mode: Z1Mode = Z1Mode.TRACKING, fsm: Fsm = Fsm.PASSIVE) -> Bench:
    clock = ManualClock(10.0)
    peer = FakeController(clock)
    peer.fsm = fsm
    link = MemoryLink(peer, clock)
    return Bench(Z1Arm(clock, Z1ArmConfig(mode=mode), link=link), peer, link, clock)


def patched(data: bytes, at: int, value: float) -> bytes:
    return data if len(data) != STATE_SIZE else data[:at] + struct.pack("<f", value) + data[at + 4 :]


@pytest.fixture
def bench() -> Bench:
    bench = make_bench()
    bench.arm.connect()
    return bench


@pytest.fixture
def low() -> Bench:
    bench = make_bench(Z1Mode.LOW_LEVEL)
    bench.arm.connect()
    return bench


@pytest.mark.parametrize(
    ("found", "returned"),
    [(Fsm.PASSIVE, Fsm.PASSIVE), (Fsm.JOINTCTRL, Fsm.JOINTCTRL), (Fsm.CARTESIAN, Fsm.JOINTCTRL)],
)
@pytest.mark.parametrize("mode", [Z1Mode.TRACKING, Z1Mode.LOW_LEVEL])
def test_an_arm_that_is_given_back_is_limp_only_if_it_was(mode: Z1Mode, found: Fsm, returned: Fsm) -> None:
    bench = make_bench(mode, found)
    bench.arm.connect()
    assert bench.peer.fsm is not Fsm.PASSIVE
    bench.arm.give_back()
    bench.arm.disconnect()
    assert bench.peer.fsm is returned


def test_an_arm_that_was_only_observed_is_given_back_without_a_request() -> None:
    bench = make_bench(Z1Mode.OBSERVE, Fsm.JOINTCTRL)
    bench.arm.connect()
    bench.arm.give_back()
    assert bench.peer.fsm is Fsm.JOINTCTRL


def make_turn(bench: Bench) -> TrajectoryCommand:
    """Return the move that turns joint1 by 2 rad."""
    q = bench.peer.q[:6] + 2.0 * np.eye(6)[0]
    posture = posture_from_pose(pivot_kinematics().forward(q))
    return TrajectoryCommand(poses=np.array([posture, np.zeros(6)]), gripper_rad=bench.peer.q[6])


# --- Connecting ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fsm", [Fsm.PASSIVE, Fsm.JOINTCTRL, Fsm.CARTESIAN, Fsm.LOWCMD, Fsm.TEACH])
@pytest.mark.parametrize("mode", [Z1Mode.TRACKING, Z1Mode.LOW_LEVEL])
def test_it_connects_from_any_state_and_the_arm_hardly_moves(mode: Z1Mode, fsm: Fsm) -> None:
    bench = make_bench(mode, fsm)
    before = bench.peer.q.copy()
    bench.arm.connect()
    assert bench.arm.fsm is {Z1Mode.TRACKING: Fsm.JOINTCTRL, Z1Mode.LOW_LEVEL: Fsm.LOWCMD}[mode]
    assert np.abs(bench.peer.q - before).max() < 0.005


def test_observing_changes_no_state_and_rejects_commands() -> None:
    bench = make_bench(Z1Mode.OBSERVE, Fsm.JOINTCTRL)
    bench.arm.connect()
    bench.clock.advance(0.1)
    assert bench.arm.read_state().q == pytest.approx(bench.peer.q, abs=1e-6)
    assert {(c.state, c.track) for c in bench.peer.received} == {(Fsm.INVALID, False)}
    with raises(CommandRejectedError, "observe_only"):
        bench.arm.send(ArmSetpoint(q=bench.peer.q, dq=REST))


def test_the_first_command_brakes_a_controller_left_in_lowcmd() -> None:
    bench = make_bench(Z1Mode.TRACKING, Fsm.LOWCMD)
    bench.arm.connect()
    first = bench.peer.received[0].joints()
    assert not first.tau.any()
    assert not first.kp.any()
    assert (first.kd > 0).all()


def test_connect_timeout_explains_the_remedy_and_leaves_nothing_open() -> None:
    bench = make_bench()
    bench.peer.mute = True
    with raises(HalTimeoutError, "no_controller") as caught:
        bench.arm.connect()
    for part in ("the fake controller", "within 2.0 s", "nothing was received", "z1_ctrl"):
        assert part in str(caught.value)
    assert 2.0 <= bench.clock.now_s() - 10.0 < 3.0
    assert not bench.link.is_open
    with pytest.raises(NotConnectedError):
        bench.arm.read_state()


def test_connect_timeout_names_the_reason_of_invalid_answers() -> None:
    bench = make_bench()
    bench.link.mangle = lambda data: [data[:100]] if len(data) == STATE_SIZE else [data]
    with raises(HalTimeoutError, "no_controller") as caught:
        bench.arm.connect()
    assert "100 bytes" in str(caught.value)


def test_a_controller_that_ignores_the_mode_is_disconnected() -> None:
    bench = make_bench()
    bench.peer.ignored_requests = {Fsm.JOINTCTRL}
    with raises(CommandRejectedError, "request_refused"):
        bench.arm.connect()
    assert bench.arm.mode is None
    assert not bench.link.is_open


def test_a_motion_of_another_client_is_awaited() -> None:
    bench = make_bench(fsm=Fsm.JOINTCTRL)
    bench.arm.connect()
    bench.arm.begin_move(Fsm.TOSTATE, "forward")
    bench.arm._modes.mode = None  # as if its program had ended
    bench.link.close()
    second = Z1Arm(bench.clock, link=bench.link)
    second.connect()
    assert bench.peer.q[:6] == pytest.approx(LABELS["forward"], abs=0.01)


def test_disconnecting_leaves_a_controller_that_holds(bench: Bench, low: Bench) -> None:
    for one in (bench, low):
        one.arm.disconnect()
        assert one.peer.fsm is Fsm.JOINTCTRL
        before = one.peer.q.copy()
        one.clock.advance(1.0)
        one.peer.move()
        assert np.abs(one.peer.q - before).max() < 1e-3


# --- Commands of the driver ---------------------------------------------------------------------------------------


def test_a_far_target_is_handed_over_one_period_at_a_time(bench: Bench) -> None:
    goal = bench.shift(0, 2.0)
    for _ in range(100):
        bench.tick(goal)
    sent = np.array([c.joints().q for c in bench.peer.received if c.track])
    assert np.abs(np.diff(sent, axis=0)).max() <= SPEED_TOLERANCE * z1.DQ_MAX[0] * PERIOD_S + 1e-6
    assert (np.abs(sent[-1] - bench.peer.q)[0]) < 0.05


def test_a_client_that_ends_in_motion_leaves_an_arm_that_holds(bench: Bench) -> None:
    goal = bench.shift(0, 2.0)
    bench.run(goal, 0.2)
    at_end = bench.peer.q.copy()
    bench.clock.advance(5.0)
    bench.peer.move()
    assert np.abs(bench.peer.q - at_end)[0] < 0.05


@pytest.mark.integration
@pytest.mark.parametrize("mode", [Z1Mode.TRACKING, Z1Mode.LOW_LEVEL])
def test_no_joint_is_commanded_beyond_its_limits(mode: Z1Mode) -> None:
    bench = make_bench(mode)
    bench.arm.connect()
    for beyond in (z1.Q_MAX + 3.0, z1.Q_MIN - 3.0):
        for _ in range(1500):
            bench.tick(beyond, np.sign(beyond) * 50.0)
    commands = [c.joints() for c in bench.peer.received[10:] if c.track or mode is Z1Mode.LOW_LEVEL]
    q = np.array([c.q for c in commands])
    assert (q >= z1.Q_MIN - 1e-6).all()
    assert (q <= z1.Q_MAX + 1e-6).all()
    assert np.abs([c.dq for c in commands]).max() <= z1.DQ_MAX.max() + 1e-6


@pytest.mark.integration
def test_no_torque_beyond_the_effort_limits_leaves_the_driver(low: Bench) -> None:
    rng = np.random.default_rng(0)
    for _ in range(500):
        q = rng.uniform(z1.Q_MIN - 1, z1.Q_MAX + 1)
        low.tick(q, rng.uniform(-50, 50, z1.N_JOINTS))
    limit = np.append(z1.TAU_MAX[:6], low.arm.limits.grip_torque_nm)
    assert (low.peer.highest_torque <= limit + 1e-3).all()
    assert (low.peer.highest_torque[:6] > 0.9 * limit[:6]).all()


@pytest.mark.integration
def test_the_lead_over_a_blocked_arm_is_bounded(bench: Bench) -> None:
    bench.peer.stuck, bench.peer.noise_rad = 0, 1e-6
    bench.run(bench.shift(0, 1.5), 1.0)
    target = bench.peer.received[-1].joints().q[0]
    assert abs(target - bench.peer.q[0]) == pytest.approx(0.35, abs=1e-3)


@pytest.mark.integration
def test_low_level_mode_carries_the_arm(low: Bench) -> None:
    held = low.peer.q.copy()
    low.run(held, 1.0)
    assert np.abs(low.peer.q - held).max() < 1e-3
    last = low.peer.received[-1].joints()
    assert last.tau[:6] == pytest.approx(low.peer.tau[:6], abs=0.05)
    assert abs(last.tau[2]) > 2.0


def test_low_level_mode_is_entered_from_passive_with_the_command_equal_to_the_measurement() -> None:
    bench = make_bench(Z1Mode.LOW_LEVEL, Fsm.JOINTCTRL)
    before = bench.peer.q.copy()
    bench.arm.connect()
    requested = [c.state for c in bench.peer.received if c.state is not Fsm.INVALID]
    assert requested.index(Fsm.PASSIVE) < requested.index(Fsm.LOWCMD)
    entry = next(c.joints() for c in bench.peer.received if c.state is Fsm.LOWCMD)
    assert entry.q == pytest.approx(before, abs=2e-3)
    assert not entry.dq.any()


def test_low_level_mode_is_not_entered_in_motion(bench: Bench) -> None:
    bench.link.mangle = lambda data: [patched(data, 10, 0.5)]  # joint1's speed in an answer
    bench.run(bench.peer.q.copy(), 0.01)
    with raises(CommandRejectedError, "arm_moving"):
        bench.arm.enter(Z1Mode.LOW_LEVEL)
    assert bench.peer.fsm is Fsm.JOINTCTRL


def test_without_lowcmd_the_arm_is_caught_by_jointctrl(bench: Bench) -> None:
    bench.peer.ignored_requests = {Fsm.LOWCMD}
    before = bench.peer.q.copy()
    with raises(CommandRejectedError, "request_refused"):
        bench.arm.enter(Z1Mode.LOW_LEVEL)
    assert bench.peer.fsm is Fsm.JOINTCTRL
    assert np.abs(bench.peer.q - before).max() < 0.1


def test_a_stop_during_the_entry_of_lowcmd_does_not_let_the_arm_sink(bench: Bench) -> None:
    def stop_during_entry(data: bytes) -> list[bytes]:
        if len(data) == COMMAND_SIZE and data[2] == Fsm.LOWCMD:
            bench.arm._client.cancelled = True  # what `stop` sets first, in another thread
            return []
        return [data]

    bench.link.mangle = stop_during_entry
    before = bench.peer.q.copy()
    with raises(CommandRejectedError, "cancelled"):
        bench.arm.enter(Z1Mode.LOW_LEVEL)
    assert bench.peer.fsm is Fsm.JOINTCTRL
    assert np.abs(bench.peer.q - before).max() < 0.02
    assert bench.arm.mode is Z1Mode.OBSERVE


def test_an_arm_that_does_not_hold_is_given_back_to_the_controller(bench: Bench) -> None:
    bench.peer.load[1] = -80.0
    with raises(CommandRejectedError, "arm_not_holding"):
        bench.arm.enter(Z1Mode.LOW_LEVEL)
    assert bench.peer.fsm is Fsm.JOINTCTRL


# --- Gripper ------------------------------------------------------------------------------------------------------


def test_the_gripper_moves_to_a_position(bench: Bench) -> None:
    bench.run(bench.shift(6, -0.5), 1.0)
    assert bench.peer.q[6] == pytest.approx(-1.0, abs=0.01)


def test_the_gripper_pushes_with_a_torque_while_tracking(bench: Bench) -> None:
    bench.peer.stuck = 6  # it holds something
    bench.arm.grip(2.0)
    bench.run(bench.peer.q.copy(), 0.2)
    lead = bench.peer.received[-1].joints().q[6] - bench.peer.q[6]
    assert lead * z1.KP[6] == pytest.approx(2.0, abs=0.01)
    bench.arm.grip(None)
    bench.run(bench.peer.q.copy(), 0.2)
    assert bench.peer.received[-1].joints().q[6] == pytest.approx(bench.peer.q[6], abs=1e-3)


def test_the_gripper_pushes_with_a_torque_in_low_level_mode(low: Bench) -> None:
    low.peer.stuck = 6
    low.arm.grip(-2.0)
    low.run(low.peer.q.copy(), 0.2)
    last = low.peer.received[-1].joints()
    assert last.kp[6] == 0.0
    assert last.tau[6] == pytest.approx(-2.0, abs=0.1)


@pytest.mark.parametrize("torque_nm", [3.1, -50.0, float("nan")])
def test_a_grip_torque_beyond_the_limit_is_rejected(bench: Bench, torque_nm: float) -> None:
    with raises(CommandRejectedError, "grip_torque") as caught:
        bench.arm.grip(torque_nm)
    assert f"{torque_nm} Nm; allowed are −3.0 to 3.0 Nm" in str(caught.value)


# --- Motions of the controller ------------------------------------------------------------------------------------


def test_it_runs_to_a_label_and_back_to_start(bench: Bench) -> None:
    bench.arm.run_label("forward")
    assert bench.peer.q[:6] == pytest.approx(LABELS["forward"], abs=0.01)
    bench.arm.back_to_start()
    assert bench.peer.q[:6] == pytest.approx(LABELS["startFlat"], abs=0.01)
    bench.run(bench.peer.q.copy(), 0.1)
    assert bench.arm.fsm is Fsm.JOINTCTRL


def test_an_unknown_label_is_rejected_and_the_arm_can_still_be_moved(bench: Bench) -> None:
    with raises(CommandRejectedError, "request_refused"):
        bench.arm.run_label("nowhere")
    goal = bench.shift(0, 0.1)
    bench.run(goal, 0.5)
    assert bench.peer.q[0] == pytest.approx(goal[0], abs=0.01)


def test_setpoints_are_rejected_during_a_controller_motion_and_a_stop_ends_it(bench: Bench) -> None:
    start = bench.peer.q[0]
    bench.arm.begin_move(Fsm.MOVEJ, make_turn(bench))
    with raises(CommandRejectedError, "controller_moving"):
        bench.tick(bench.peer.q.copy())
    bench.arm.stop()
    bench.clock.advance(1.0)
    bench.arm.read_state()
    assert bench.peer.fsm is Fsm.JOINTCTRL
    assert abs(bench.peer.q[0] - start) < 0.2
    bench.run(bench.peer.q.copy(), 0.1)


def test_a_motion_that_ends_in_another_state_is_an_error(bench: Bench) -> None:
    bench.arm.begin_move(Fsm.MOVEJ, make_turn(bench))
    bench.peer.fsm = Fsm.PASSIVE
    with raises(CommandRejectedError, "motion_failed"):
        bench.arm.end_move()


def test_a_motion_that_takes_too_long_is_an_error(bench: Bench) -> None:
    bench.peer.stuck = 0
    bench.arm.begin_move(Fsm.MOVEJ, make_turn(bench))
    with raises(HalTimeoutError, "motion_timeout"):
        bench.arm.end_move(1.0)


def test_no_controller_motion_starts_from_low_level_mode(low: Bench) -> None:
    with raises(CommandRejectedError, "wrong_mode"):
        low.arm.run_label("forward")
    assert low.peer.fsm is Fsm.LOWCMD


def test_passive_lets_the_arm_sink(bench: Bench) -> None:
    bench.arm.go_passive()
    before = bench.peer.q[2]
    bench.clock.advance(0.2)
    bench.arm.read_state()
    assert bench.peer.fsm is Fsm.PASSIVE
    assert abs(bench.peer.q[2] - before) > 0.02
    with raises(CommandRejectedError, "observe_only"):
        bench.arm.send(ArmSetpoint(q=bench.peer.q, dq=REST))


# --- Faults -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("motor", "field", "value", "text"),
    [
        ((0, 0), "error", MotorError.OVER_CURRENT, "joint1: over-current"),
        ((1, 0), "error", MotorError.LEAKAGE, "joint2 motor 1: leakage current"),
        ((1, 1), "error", MotorError.OVERHEAT, "joint2 motor 2: overheat"),
        ((5, 0), "error", MotorError.PARAMETER_JUMP, "joint6: parameter jump"),
        ((6, 0), "error", 0x80, "gripper: unknown error 0x80"),
        ((3, 0), "link", MotorLink.LOST, "joint4: motor lost"),
        ((1, 1), "link", MotorLink.CRC_ERROR, "joint2 motor 2: CRC errors"),
        ((4, 0), "link", 3, "joint5: unknown link state 3"),
    ],
)
def test_a_motor_fault_is_decoded_and_latched(
    bench: Bench, motor: tuple[int, int], field: str, value: int, text: str
) -> None:
    q = bench.peer.q.copy()
    getattr(bench.peer, field)[motor] = value
    bench.run(q, 0.05)
    assert bench.arm.read_state().faults == (text,)
    getattr(bench.peer, field)[:] = 0
    bench.run(q, 1.0)
    assert bench.arm.read_state().faults == ()
    assert [fault.text for fault in bench.arm.diagnostics().faults] == [text]
    bench.arm.clear_faults()
    assert bench.arm.diagnostics().faults == ()


def test_ignored_bits_and_absent_motors_are_no_faults(bench: Bench) -> None:
    bench.peer.error[:] = MotorError.IGNORE
    bench.peer.error[[0, 2, 3, 4, 5, 6], 1] = MotorError.OVERHEAT  # motors that do not exist
    bench.run(bench.peer.q.copy(), 0.1)
    assert bench.arm.read_state().faults == ()


def test_a_single_garbled_answer_of_a_motor_is_no_fault(bench: Bench) -> None:
    q = bench.peer.q.copy()
    bench.peer.link[3, 0] = MotorLink.CRC_ERROR
    bench.run(q, 0.010)
    bench.peer.link[:] = MotorLink.OK
    bench.run(q, 0.1)
    assert bench.arm.diagnostics().faults == ()


def test_temperatures_are_reported_per_motor(bench: Bench) -> None:
    bench.peer.temperature_c[:, 0] = range(40, 47)
    bench.peer.temperature_c[1, 1] = -5
    bench.run(bench.peer.q.copy(), 0.01)
    assert bench.arm.diagnostics().temperatures_c.tolist() == [40, 41, -5, 42, 43, 44, 45, 46]


def test_a_controller_that_falls_silent_is_detected(bench: Bench) -> None:
    q = bench.peer.q.copy()
    bench.run(q, 0.02)
    bench.peer.mute = True
    with raises(HalTimeoutError, "stale_state"):
        bench.run(q, 0.2)
    bench.peer.mute = False
    bench.clock.advance(0.03)
    bench.run(q, 0.1)


@pytest.mark.integration
def test_a_silent_motor_board_is_detected_only_during_a_commanded_motion(bench: Bench) -> None:
    q = bench.peer.q.copy()
    bench.peer.silence_board(True)
    bench.run(q, 2.0)  # at rest, an arm without noise repeats one measurement
    assert bench.arm.diagnostics().unchanged_s > 1.9
    goal = bench.shift(0, 0.2)
    with raises(HalTimeoutError, "stale_measurement"):
        bench.run(goal, 0.3)
    bench.peer.silence_board(False)
    bench.clock.advance(0.03)
    bench.run(goal, 0.5)
    assert bench.peer.q[0] == pytest.approx(goal[0], abs=0.01)


def test_a_controller_switched_by_another_client_is_detected(bench: Bench) -> None:
    q = bench.peer.q.copy()
    bench.peer.fsm = Fsm.PASSIVE
    with raises(CommandRejectedError, "controller_left_state"):
        bench.run(q, 0.1)
    assert bench.arm.read_state().faults == (
        "the controller changed from JOINTCTRL to PASSIVE without a request of this driver",
    )
    bench.arm.disconnect()
    bench.arm.connect()
    bench.run(bench.peer.q.copy(), 0.1)


def test_an_old_answer_is_not_used_as_a_new_one(bench: Bench) -> None:
    bench.tick(bench.peer.q.copy())  # its answer waits
    bench.peer.mute = True
    bench.clock.advance(1.0)
    with raises(HalTimeoutError, "stale_state"):
        bench.arm.read_state()


def test_one_outlier_answer_is_dropped_and_a_second_accepted(bench: Bench) -> None:
    q = bench.peer.q.copy()
    bench.run(q, 0.02)
    bench.peer.q[0] += 1.0
    bench.arm.send(ArmSetpoint(q=q, dq=REST))
    bench.peer.q[0] -= 1.0
    bench.clock.advance(PERIOD_S)
    assert bench.arm.read_state().q == pytest.approx(q, abs=1e-3)
    assert bench.arm.diagnostics().counts.jumps == 1
    bench.peer.q[0] += 1.0
    bench.peer.target[0] += 1.0
    bench.peer.tracking = False
    bench.run(q, 0.01)
    assert abs(bench.arm.read_state().q[0] - q[0]) > 0.5


@pytest.mark.integration
@pytest.mark.parametrize("mode", [Z1Mode.TRACKING, Z1Mode.LOW_LEVEL])
def test_the_arm_follows_over_a_bad_network(mode: Z1Mode) -> None:
    """A tenth of all datagrams lost, doubled, late, cut, too long, changed or random."""
    bench = make_bench(mode)
    bench.arm.connect()
    bench.link.mangle = mangle_at_random(np.random.default_rng(1), 0.1)
    start = bench.peer.q.copy()
    for i in range(3000):
        goal = start.copy()
        goal[0] += 0.5 * np.sin(2e-3 * i)
        bench.tick(goal)
        assert abs(bench.peer.q[0] - goal[0]) < 0.05
    counts = bench.arm.diagnostics().counts
    assert counts.invalid > 20
    assert counts.answers > 1200
    assert bench.peer.invalid_datagrams > 50
    assert all(fault.startswith("joint") for fault in bench.arm.read_state().faults)


@pytest.mark.integration
def test_a_hostile_network_raises_only_known_errors() -> None:
    """Every datagram is mangled; only a timeout or a rejection may be raised."""
    bench = make_bench()
    bench.arm.connect()
    bench.link.mangle = mangle_at_random(np.random.default_rng(2), 1.0)
    q = bench.peer.q.copy()
    for _ in range(3000):
        try:
            bench.tick(q)
        except (HalTimeoutError, CommandRejectedError):
            bench.clock.advance(PERIOD_S)
    assert bench.arm.diagnostics().counts.invalid > 20
    assert np.abs(bench.peer.q - q).max() < 0.5


# --- Under the servo ----------------------------------------------------------------------------------------------


def play(bench: Bench, inject_fault: Callable[[], None]) -> Servo:
    """Start a trajectory of joint1, inject a fault in the middle of it, and let the servo finish."""
    servo = Servo(bench.arm, bench.clock)
    servo.connect()
    servo.claim("test")
    q = servo.read_state().q
    t_s = np.linspace(0, 2, 101)
    path = np.tile(q, (101, 1))
    u = t_s / 2
    path[:, 0] += 10 * u**3 - 15 * u**4 + 6 * u**5
    speed = np.zeros_like(path)
    speed[:, 0] = (30 * u**2 - 60 * u**3 + 30 * u**4) / 2
    servo.stream(TrajectoryChunk(trajectory_id=1, t_s=t_s, q=path, dq=speed, final=True))
    for i in range(1250):
        if i == 400:
            inject_fault()
        servo.tick()
        bench.clock.advance(PERIOD_S)
    return servo


@pytest.mark.integration
def test_a_trajectory_is_executed_to_its_end() -> None:
    bench = make_bench()
    servo = play(bench, lambda: None)
    assert servo.status().finished
    assert bench.peer.q[0] == pytest.approx(1.0, abs=0.01)


@pytest.mark.integration
def test_a_motor_fault_latches_the_servo_during_the_motion() -> None:
    bench = make_bench()
    servo = play(bench, lambda: bench.peer.error.__setitem__((2, 0), MotorError.OVERHEAT))
    assert servo.status().mode is ServoMode.STOPPED
    assert "joint3: overheat" in servo.status().reason
    assert 0.2 < bench.peer.q[0] < 0.6


@pytest.mark.integration
def test_a_motor_board_that_falls_silent_latches_the_servo() -> None:
    bench = make_bench()
    servo = play(bench, lambda: bench.peer.silence_board(True))
    assert servo.status().mode is ServoMode.STOPPED
    assert "repeated one measurement" in servo.status().reason


@pytest.mark.integration
def test_a_controller_that_ends_latches_the_servo() -> None:
    bench = make_bench()
    servo = play(bench, lambda: setattr(bench.peer, "mute", True))
    assert servo.status().mode is ServoMode.STOPPED
    assert "has not answered" in servo.status().reason
