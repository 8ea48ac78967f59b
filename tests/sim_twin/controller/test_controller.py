"""State machine of the controller with ideal motors, and its motors on the twin's physics."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hal.base import z1
from hal.base.z1_kinematics import PivotKinematics, pose_from_posture, posture_from_pose
from hal.z1_protocol.controller import (
    KD_JOINTCTRL,
    KD_PASSIVE,
    KP_JOINTCTRL,
    LABELS,
    TrajectoryCommand,
    decode_command,
    encode_command,
)
from hal.z1_protocol.records import JointCommands, JointStates, ProtocolError
from hal.z1_protocol.states import MOVES, Fsm, is_granted
from sim_twin.controller.controlled_world import ControlledWorld
from sim_twin.controller.controller import LABEL_SPEED, Controller
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.errors import raises

START = np.append(z1.Q_HOME, -0.5)
UNSUPPORTED = {Fsm.SETTRAJ, Fsm.TRAJECTORY, Fsm.NEXT}


class IdealArm:
    """A controller whose motors are at their commanded positions, or where a test sets them."""

    def __init__(self, q: np.ndarray = START) -> None:
        self.states = JointStates(q=q.copy())
        self.controller = Controller(self.states)
        self.commands = JointCommands()
        self.max_speed = 0.0

    def request(
        self, state: Fsm, body: JointCommands | TrajectoryCommand | str | None = None, track: bool = False
    ) -> Fsm:
        self.controller.handle_command(decode_command(encode_command(state, body, track=track)))
        return self.controller.fsm

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / 0.002)):
            self.commands = self.controller.step(self.states, 0.002)
            if self.commands.kp.any() and self.controller.fsm is not Fsm.LOWCMD:
                step = np.abs(self.commands.q - self.states.q).max() / 0.002
                self.max_speed = max(self.max_speed, float(step))
                self.states = replace(self.states, q=self.commands.q)

    def finish(self, timeout_s: float = 20.0) -> None:
        for _ in range(round(timeout_s / 0.1)):
            if self.controller.fsm not in MOVES:
                return
            self.run(0.1)
        pytest.fail(f"still in {self.controller.fsm.name}")

    @property
    def pose(self) -> np.ndarray:
        return self.controller.answer().pose


@pytest.fixture
def arm() -> IdealArm:
    return IdealArm()


def pose_at(q: np.ndarray) -> np.ndarray:
    return posture_from_pose(PivotKinematics().forward(q[:6]))


def shift(posture: np.ndarray, *by: float) -> np.ndarray:
    return posture + np.array(by)


def move_to(*postures: np.ndarray, gripper: float = -0.5, speed: float = 1.0) -> TrajectoryCommand:
    poses = np.zeros((2, 6))
    poses[: len(postures)] = postures
    return TrajectoryCommand(poses=poses, gripper_rad=gripper, max_speed=speed)


def make_body(requested: Fsm) -> JointCommands | TrajectoryCommand | str | None:
    match requested:
        case Fsm.MOVEJ | Fsm.MOVEL:
            return move_to(pose_at(LABELS["forward"]))
        case Fsm.MOVEC:
            here = pose_at(START)
            return move_to(shift(here, 0, 0, 0, 0.02, 0.02, 0), shift(here, 0, 0, 0, 0, 0.04, 0))
        case Fsm.TOSTATE:
            return "forward"
        case Fsm.SAVESTATE | Fsm.TEACH:
            return "mine"
        case Fsm.TEACHREPEAT:
            return "known"
        case _:
            return None


# --- The table ----------------------------------------------------------------------------------------------------


def bring_to(state: Fsm) -> IdealArm:
    arm = IdealArm()
    arm.controller.recordings["known"] = np.linspace(START, START + 0.05, 20)
    if state is Fsm.PASSIVE:
        return arm
    if state not in (Fsm.LOWCMD, Fsm.CALIBRATION):
        arm.request(Fsm.JOINTCTRL)
    arm.request(state, make_body(state))
    assert arm.controller.fsm is state
    return arm


@pytest.mark.parametrize(
    "present", [state for state in Fsm if state not in UNSUPPORTED | {Fsm.INVALID}], ids=lambda s: s.name
)
def test_every_request_is_granted_or_ignored_as_in_the_table(present: Fsm) -> None:
    for requested in Fsm:
        arm = bring_to(present)
        granted = is_granted(present, requested) and requested not in UNSUPPORTED | {Fsm.INVALID}
        expected = requested if granted else present
        assert arm.request(requested, make_body(requested)) is expected, requested.name


@pytest.mark.parametrize("state", sorted(MOVES - UNSUPPORTED), ids=lambda s: s.name)
def test_every_motion_falls_back_to_joint_control_by_itself(state: Fsm) -> None:
    arm = bring_to(state)
    arm.finish()
    assert arm.controller.fsm is Fsm.JOINTCTRL


def test_back_to_start_may_begin_in_passive(arm: IdealArm) -> None:
    assert arm.request(Fsm.BACKTOSTART) is Fsm.BACKTOSTART
    arm.finish()
    assert arm.states.q[:6] == pytest.approx(LABELS["startFlat"])
    assert arm.states.q[6] == START[6]


# --- Motions of the controller ------------------------------------------------------------------------------------


def test_movej_reaches_its_goal_within_the_requested_speed(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    goal = pose_at(LABELS["forward"])
    arm.request(Fsm.MOVEJ, move_to(goal, gripper=-1.0, speed=0.8))
    arm.finish()
    assert arm.pose == pytest.approx(goal, abs=1e-6)
    assert arm.states.q[6] == pytest.approx(-1.0)
    assert 0.7 < arm.max_speed <= 0.8 + 1e-6
    assert (arm.states.q >= z1.Q_MIN).all()
    assert (arm.states.q <= z1.Q_MAX).all()


@pytest.mark.parametrize("state", [Fsm.MOVEJ, Fsm.MOVEL, Fsm.MOVEC], ids=lambda s: s.name)
def test_a_pose_out_of_reach_gives_joint_control_at_once_and_no_motion(arm: IdealArm, state: Fsm) -> None:
    arm.request(Fsm.CARTESIAN)
    for far in (2.0, 1e300):
        assert arm.request(state, move_to(np.array([0, 0, 0, far, 0, 0.4]), pose_at(START))) is Fsm.JOINTCTRL
    arm.run(0.2)
    assert arm.states.q == pytest.approx(START)


def test_a_move_without_speed_is_no_move(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    assert arm.request(Fsm.MOVEJ, move_to(pose_at(LABELS["forward"]), speed=0.0)) is Fsm.JOINTCTRL


def test_movel_keeps_to_the_line(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    start = pose_at(START)
    goal = shift(start, 0, 0, 0, -0.05, 0.10, 0.05)
    arm.request(Fsm.MOVEL, move_to(goal, speed=0.1))
    line, poses, before = (goal - start)[3:], [], start[3:]
    while arm.controller.fsm is Fsm.MOVEL:
        arm.run(0.02)
        poses.append(arm.pose)
        assert np.linalg.norm(poses[-1][3:] - before) <= 0.1 * 0.02 + 1e-4
        before = poses[-1][3:]
    assert poses[-1] == pytest.approx(goal, abs=1e-5)
    distances = [np.linalg.norm(np.cross(p[3:] - start[3:], line)) / np.linalg.norm(line) for p in poses]
    assert max(distances) < 5e-4


def test_movec_follows_the_arc_through_the_middle(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    start = pose_at(START)
    centre = shift(start, 0, 0, 0, 0, 0.05, 0)
    arm.request(Fsm.MOVEC, move_to(shift(centre, 0, 0, 0, -0.05, 0, 0), shift(centre, 0, 0, 0, 0, 0.05, 0), speed=0.1))
    radii, nearest = [], 1.0
    while arm.controller.fsm is Fsm.MOVEC:
        arm.run(0.02)
        radii.append(np.linalg.norm((arm.pose - centre)[3:]))
        nearest = min(nearest, float(np.linalg.norm((arm.pose - centre)[3:] - [-0.05, 0, 0])))
    assert radii == pytest.approx(np.full(len(radii), 0.05), abs=5e-4)
    assert nearest < 2e-3
    assert arm.pose == pytest.approx(shift(centre, 0, 0, 0, 0, 0.05, 0), abs=1e-5)


def test_three_collinear_points_make_no_arc(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    start = pose_at(START)
    assert (
        arm.request(Fsm.MOVEC, move_to(shift(start, 0, 0, 0, 0, 0.02, 0), shift(start, 0, 0, 0, 0, 0.04, 0)))
        is Fsm.JOINTCTRL
    )


def test_a_known_label_is_reached_and_an_unknown_one_ignored(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    assert arm.request(Fsm.TOSTATE, "nowhere") is Fsm.JOINTCTRL
    arm.request(Fsm.TOSTATE, "forward")
    arm.finish()
    assert arm.states.q[:6] == pytest.approx(LABELS["forward"])
    assert arm.max_speed <= LABEL_SPEED + 1e-6


def test_a_saved_label_is_reached(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.SAVESTATE, "mine")
    arm.finish()
    arm.request(Fsm.TOSTATE, "forward")
    arm.finish()
    arm.request(Fsm.TOSTATE, "mine")
    arm.finish()
    assert arm.states.q == pytest.approx(START)


def test_a_motion_can_be_interrupted(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.TOSTATE, "forward")
    arm.run(0.3)
    assert arm.request(Fsm.JOINTCTRL) is Fsm.JOINTCTRL
    interrupted = arm.states.q
    arm.run(0.5)
    assert arm.states.q == pytest.approx(interrupted)
    assert np.abs(interrupted[:6] - LABELS["forward"]).max() > 0.1


def test_a_motion_taught_by_hand_is_repeated(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.TEACH, "wave")
    for i in range(200):
        q = START.copy()
        q[0] += 0.4 * np.sin(np.pi * i / 200)
        arm.states = JointStates(q=q)
        arm.run(0.01)
    assert not arm.commands.kp.any()
    assert np.abs(arm.commands.tau).max() > 1.0  # gravity is compensated
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.TEACHREPEAT, "wave")
    replayed = []
    while arm.controller.fsm is Fsm.TEACHREPEAT:
        arm.run(0.02)
        replayed.append(arm.states.q[0] - START[0])
    assert max(replayed) == pytest.approx(0.4, abs=0.005)
    assert len(replayed) * 0.02 == pytest.approx(2.0, abs=0.3)
    assert arm.request(Fsm.TEACHREPEAT, "unknown") is Fsm.JOINTCTRL


def test_calibration_makes_the_present_pose_the_zero_and_ends_in_passive(arm: IdealArm) -> None:
    arm.request(Fsm.CALIBRATION)
    arm.run(0.1)
    assert arm.controller.fsm is Fsm.PASSIVE
    assert arm.controller.measured.q == pytest.approx([0, 0, 0, 0, 0, 0, START[6]])
    arm.request(Fsm.JOINTCTRL)
    arm.run(0.1)
    assert arm.states.q == pytest.approx(START)


# --- Tracking -----------------------------------------------------------------------------------------------------


def test_tracking_catches_up_at_pi_radians_a_second(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.INVALID, JointCommands(q=START + 0.5), track=True)
    arm.run(0.1)
    assert arm.states.q - START == pytest.approx(np.full(7, 0.1 * np.pi))
    arm.run(0.1)
    assert arm.states.q == pytest.approx(START + 0.5)


def test_tracking_has_no_position_limit(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    q = START.copy()
    q[0] = 5.0
    arm.request(Fsm.INVALID, JointCommands(q=q), track=True)
    arm.run(2.0)
    assert arm.states.q[0] == pytest.approx(5.0)


def test_without_a_client_the_arm_moves_to_the_last_target_and_holds_it(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.INVALID, JointCommands(q=START - 0.4, dq=np.full(7, -0.5)), track=True)
    arm.run(30.0)
    assert arm.controller.fsm is Fsm.JOINTCTRL
    assert arm.commands.q == pytest.approx(START - 0.4)
    assert not arm.commands.dq.any()


def test_a_command_that_is_not_tracked_moves_nothing(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.INVALID, JointCommands(q=START + 0.5))
    arm.run(0.5)
    assert arm.states.q == pytest.approx(START)


def test_the_commanded_speed_reaches_the_motors_up_to_the_limit(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.INVALID, JointCommands(q=START, dq=np.array([0.3, 50, 0, 0, 0, 0, 0])), track=True)
    arm.run(0.002)
    assert arm.commands.dq == pytest.approx([0.3, np.pi, 0, 0, 0, 0, 0])
    assert (arm.commands.kp == KP_JOINTCTRL).all()
    assert (arm.commands.kd == KD_JOINTCTRL).all()


def test_a_tracked_pose_is_followed_and_one_out_of_reach_is_not(arm: IdealArm) -> None:
    arm.request(Fsm.CARTESIAN)
    goal = shift(pose_at(START), 0, 0, 0.05, 0, 0.02, 0.01)
    arm.request(Fsm.INVALID, move_to(goal, gripper=-0.7), track=True)
    arm.run(0.5)
    assert arm.pose == pytest.approx(goal, abs=1e-6)
    assert arm.states.q[6] == pytest.approx(-0.7)
    for far in (2.0, 1e200):
        arm.request(Fsm.INVALID, move_to(np.array([0, 0, 0, far, 0, 0])), track=True)
        arm.run(0.2)
    assert arm.pose == pytest.approx(goal, abs=1e-6)
    assert arm.controller.fsm is Fsm.CARTESIAN


# --- PASSIVE and LOWCMD -------------------------------------------------------------------------------------------


def test_passive_is_damping_alone(arm: IdealArm) -> None:
    arm.run(0.01)
    assert not arm.commands.kp.any()
    assert not arm.commands.tau.any()
    assert (arm.commands.kd == KD_PASSIVE).all()


def test_lowcmd_clamps_position_and_speed_but_no_torque_and_persists(arm: IdealArm) -> None:
    desired = JointCommands(
        q=np.full(7, 9.0), dq=np.full(7, 50.0), tau=np.full(7, 700.0), kp=KP_JOINTCTRL, kd=KD_PASSIVE
    )
    arm.request(Fsm.LOWCMD, desired)
    arm.run(10.0)
    assert arm.controller.fsm is Fsm.LOWCMD
    assert arm.commands.q == pytest.approx(z1.Q_MAX)
    assert arm.commands.dq == pytest.approx(z1.DQ_MAX)
    assert (arm.commands.tau == 700.0).all()
    assert arm.commands.kp == pytest.approx(KP_JOINTCTRL)


def test_after_lowcmd_the_arm_is_held_where_it_is(arm: IdealArm) -> None:
    arm.request(Fsm.LOWCMD, JointCommands(q=START))
    arm.states = JointStates(q=START - 0.3)
    arm.run(0.01)
    assert arm.request(Fsm.JOINTCTRL) is Fsm.JOINTCTRL
    arm.run(0.5)
    assert arm.states.q == pytest.approx(START - 0.3)


def test_a_body_that_is_not_finite_changes_nothing(arm: IdealArm) -> None:
    broken = bytearray(encode_command(Fsm.LOWCMD))
    broken[7:11] = np.float32(np.nan).tobytes()
    with raises(ProtocolError, "not_finite"):
        arm.controller.handle_command(decode_command(bytes(broken)))
    assert arm.controller.fsm is Fsm.PASSIVE
    arm.request(Fsm.JOINTCTRL)
    with raises(ProtocolError, "label"):
        arm.controller.handle_command(decode_command(encode_command(Fsm.TOSTATE)))
    assert arm.controller.fsm is Fsm.JOINTCTRL


# --- On the twin's physics ----------------------------------------------------------------------------------------


@pytest.fixture
def twin() -> ControlledWorld:
    return ControlledWorld(World(SceneConfig()))


def run(twin: ControlledWorld, duration_s: float) -> np.ndarray:
    for _ in range(round(duration_s / 0.002)):
        twin.tick()
        twin.world.step()
    return twin.world.read_arm()[0]


def test_the_arm_stays_parked_until_the_first_command_and_then_sinks(twin: ControlledWorld) -> None:
    parked = run(twin, 0.5)
    assert not twin.awake
    assert twin.handle(encode_command(Fsm.INVALID)) is not None
    assert np.abs(run(twin, 0.5) - parked).max() > 0.1


def test_joint_control_carries_the_arm_and_movej_reaches_its_goal(twin: ControlledWorld) -> None:
    before = twin.world.read_arm()[0]
    twin.handle(encode_command(Fsm.JOINTCTRL))
    assert np.abs(run(twin, 0.5) - before).max() < 0.01
    goal = pose_at(LABELS["forward"])
    twin.handle(encode_command(Fsm.MOVEJ, move_to(goal, gripper=-1.0, speed=1.5)))
    max_speed = 0.0
    while twin.controller.fsm is Fsm.MOVEJ:
        run(twin, 0.01)
        max_speed = max(max_speed, float(np.abs(twin.world.read_arm()[1]).max()))
    assert max_speed < 1.6
    run(twin, 0.5)
    assert pose_from_posture(twin.controller.answer().pose) == pytest.approx(pose_from_posture(goal), abs=0.01)


def test_a_torque_beyond_the_motors_is_passed_on_and_ends_at_their_effort_limit(twin: ControlledWorld) -> None:
    tau = np.zeros(7)
    tau[0] = 700.0
    twin.handle(encode_command(Fsm.LOWCMD, JointCommands(q=twin.world.read_arm()[0], tau=tau)))
    run(twin, 0.01)
    assert twin.world.read_arm()[2][0] == pytest.approx(z1.TAU_MAX[0])


def test_every_second_answer_repeats_the_measurement(twin: ControlledWorld) -> None:
    twin.handle(encode_command(Fsm.INVALID))
    run(twin, 0.1)
    answers = []
    for _ in range(40):
        run(twin, 0.002)
        answers.append(twin.answer())
    assert sum(a == b for a, b in pairwise(answers)) in (19, 20)


def test_a_silent_board_leaves_stale_answers_and_is_recovered_from(twin: ControlledWorld) -> None:
    twin.handle(encode_command(Fsm.INVALID))  # in PASSIVE it sinks
    run(twin, 0.1)
    twin.motors.silent = True
    run(twin, 0.01)
    stale = twin.answer()
    run(twin, 0.5)
    assert twin.answer() == stale
    twin.motors.silent = False
    run(twin, 0.01)
    assert twin.answer() != stale


def test_gains_beyond_all_reason_do_not_break_the_physics(twin: ControlledWorld) -> None:
    big = np.full(7, 3e38)
    twin.handle(encode_command(Fsm.LOWCMD, JointCommands(q=big, dq=-big, tau=-big, kp=big, kd=big)))
    run(twin, 0.5)
    twin.handle(encode_command(Fsm.INVALID, JointCommands(kp=-big, kd=-big)))
    q = run(twin, 0.5)
    assert np.isfinite(q).all()
    assert twin.world.data.time > 0.9  # MuJoCo resets its state when it diverges
    assert not twin.world.data.warning.number.any()
    assert twin.handle(encode_command(Fsm.JOINTCTRL)) is not None


def test_random_bytes_and_mutilated_commands_are_counted_and_never_crash(twin: ControlledWorld) -> None:
    rng = np.random.default_rng(5)
    goods = [encode_command(state, make_body(state), track=bool(state % 2)) for state in Fsm]
    rejected = 0
    for i in range(5000):
        data = bytearray(goods[rng.integers(len(goods))])
        for _ in range(rng.integers(1, 8)):
            data[rng.integers(len(data))] = rng.integers(256)
        data = (bytes(data), bytes(data[: rng.integers(147)]), rng.bytes(int(rng.integers(0, 400))))[i % 3]
        rejected += twin.handle(data) is None
        if i % 10 == 0:
            run(twin, 0.002)
            assert len(twin.answer()) == 208
    assert twin.invalid_datagrams == rejected > 3000
    assert twin.invalid_reason
    assert np.isfinite(twin.world.read_arm()[0]).all()


def test_the_worlds_own_servos_resume_from_released_motors(twin: ControlledWorld) -> None:
    twin.handle(encode_command(Fsm.LOWCMD))  # neither stiffness nor torque: it falls
    q = run(twin, 0.1)
    assert np.abs(twin.world.read_arm()[1]).max() > 0.5
    twin.world.set_command(q, np.zeros(7))
    for _ in range(500):
        twin.world.step()
    assert np.abs(twin.world.read_arm()[0] - q).max() < 0.02
