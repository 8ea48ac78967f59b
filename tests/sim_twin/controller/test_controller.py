"""The controller's rules, with motors that follow at once; and its motors on the twin's physics."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hal.base import z1
from hal.compat.unitree_arm_interface.model import Z1Model, homoToPosture, postureToHomo
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

START = np.append(z1.Q_HOME, -0.5)
UNSUPPORTED = {Fsm.SETTRAJ, Fsm.TRAJECTORY, Fsm.NEXT}


class IdealArm:
    """A controller whose motors are where they are told to be, or where a hand puts them."""

    def __init__(self, q: np.ndarray = START) -> None:
        self.states = JointStates(q=q.copy())
        self.controller = Controller(self.states)
        self.told = JointCommands()
        self.fastest = 0.0

    def ask(self, state: Fsm, body: JointCommands | TrajectoryCommand | str | None = None, track: bool = False) -> Fsm:
        self.controller.obey(decode_command(encode_command(state, body, track=track)))
        return self.controller.fsm

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / 0.002)):
            self.told = self.controller.step(self.states, 0.002)
            if self.told.kp.any() and self.controller.fsm is not Fsm.LOWCMD:
                step = np.abs(self.told.q - self.states.q).max() / 0.002
                self.fastest = max(self.fastest, float(step))
                self.states = replace(self.states, q=self.told.q)

    def finish(self, longest_s: float = 20.0) -> None:
        for _ in range(round(longest_s / 0.1)):
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
    return homoToPosture(Z1Model.with_gripper().forwardKinematics(q[:6]))


def shifted(posture: np.ndarray, *by: float) -> np.ndarray:
    return posture + np.array(by)


def move_to(*postures: np.ndarray, gripper: float = -0.5, speed: float = 1.0) -> TrajectoryCommand:
    poses = np.zeros((2, 6))
    poses[: len(postures)] = postures
    return TrajectoryCommand(poses=poses, gripper_rad=gripper, max_speed=speed)


def bodies(asked: Fsm) -> JointCommands | TrajectoryCommand | str | None:
    match asked:
        case Fsm.MOVEJ | Fsm.MOVEL:
            return move_to(pose_at(LABELS["forward"]))
        case Fsm.MOVEC:
            here = pose_at(START)
            return move_to(shifted(here, 0, 0, 0, 0.02, 0.02, 0), shifted(here, 0, 0, 0, 0, 0.04, 0))
        case Fsm.TOSTATE:
            return "forward"
        case Fsm.SAVESTATE | Fsm.TEACH:
            return "mine"
        case Fsm.TEACHREPEAT:
            return "known"
        case _:
            return None


# --- The table ----------------------------------------------------------------------------------------------------


def brought_to(state: Fsm) -> IdealArm:
    arm = IdealArm()
    arm.controller.recordings["known"] = np.linspace(START, START + 0.05, 20)
    if state is Fsm.PASSIVE:
        return arm
    if state not in (Fsm.LOWCMD, Fsm.CALIBRATION):
        arm.ask(Fsm.JOINTCTRL)
    arm.ask(state, bodies(state))
    assert arm.controller.fsm is state
    return arm


@pytest.mark.parametrize(
    "now", [state for state in Fsm if state not in UNSUPPORTED | {Fsm.INVALID}], ids=lambda s: s.name
)
def test_every_request_is_granted_or_ignored_as_the_table_says(now: Fsm) -> None:
    for asked in Fsm:
        arm = brought_to(now)
        follows = is_granted(now, asked) and asked is not Fsm.INVALID and asked not in UNSUPPORTED
        assert arm.ask(asked, bodies(asked)) is (asked if follows else now), asked.name


@pytest.mark.parametrize("state", sorted(MOVES - UNSUPPORTED), ids=lambda s: s.name)
def test_every_motion_falls_back_to_joint_control_by_itself(state: Fsm) -> None:
    arm = brought_to(state)
    arm.finish()
    assert arm.controller.fsm is Fsm.JOINTCTRL


def test_the_way_back_to_start_may_begin_in_passive(arm: IdealArm) -> None:
    assert arm.ask(Fsm.BACKTOSTART) is Fsm.BACKTOSTART
    arm.finish()
    assert arm.states.q[:6] == pytest.approx(LABELS["startFlat"])
    assert arm.states.q[6] == START[6]


# --- Its own motions ------------------------------------------------------------------------------------------------


def test_movej_reaches_its_goal_no_faster_than_asked(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    goal = pose_at(LABELS["forward"])
    arm.ask(Fsm.MOVEJ, move_to(goal, gripper=-1.0, speed=0.8))
    arm.finish()
    assert arm.pose == pytest.approx(goal, abs=1e-6)
    assert arm.states.q[6] == pytest.approx(-1.0)
    assert 0.7 < arm.fastest <= 0.8 + 1e-6
    assert (arm.states.q >= z1.Q_MIN).all()
    assert (arm.states.q <= z1.Q_MAX).all()


@pytest.mark.parametrize("state", [Fsm.MOVEJ, Fsm.MOVEL, Fsm.MOVEC], ids=lambda s: s.name)
def test_a_pose_out_of_reach_gives_joint_control_at_once_and_no_motion(arm: IdealArm, state: Fsm) -> None:
    arm.ask(Fsm.CARTESIAN)
    for far in (2.0, 1e300):
        assert arm.ask(state, move_to(np.array([0, 0, 0, far, 0, 0.4]), pose_at(START))) is Fsm.JOINTCTRL
    arm.run(0.2)
    assert arm.states.q == pytest.approx(START)


def test_a_move_without_speed_is_no_move(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    assert arm.ask(Fsm.MOVEJ, move_to(pose_at(LABELS["forward"]), speed=0.0)) is Fsm.JOINTCTRL


def test_movel_keeps_to_the_line(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    start = pose_at(START)
    goal = shifted(start, 0, 0, 0, -0.05, 0.10, 0.05)
    arm.ask(Fsm.MOVEL, move_to(goal, speed=0.1))
    way, places, before = (goal - start)[3:], [], start[3:]
    while arm.controller.fsm is Fsm.MOVEL:
        arm.run(0.02)
        places.append(arm.pose)
        assert np.linalg.norm(places[-1][3:] - before) <= 0.1 * 0.02 + 1e-4
        before = places[-1][3:]
    assert places[-1] == pytest.approx(goal, abs=1e-5)
    aside = [np.linalg.norm(np.cross(p[3:] - start[3:], way)) / np.linalg.norm(way) for p in places]
    assert max(aside) < 5e-4


def test_movec_goes_round_through_the_middle(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    start = pose_at(START)
    centre = shifted(start, 0, 0, 0, 0, 0.05, 0)
    arm.ask(Fsm.MOVEC, move_to(shifted(centre, 0, 0, 0, -0.05, 0, 0), shifted(centre, 0, 0, 0, 0, 0.05, 0), speed=0.1))
    radii, nearest = [], 1.0
    while arm.controller.fsm is Fsm.MOVEC:
        arm.run(0.02)
        radii.append(np.linalg.norm((arm.pose - centre)[3:]))
        nearest = min(nearest, float(np.linalg.norm((arm.pose - centre)[3:] - [-0.05, 0, 0])))
    assert radii == pytest.approx(np.full(len(radii), 0.05), abs=5e-4)
    assert nearest < 2e-3
    assert arm.pose == pytest.approx(shifted(centre, 0, 0, 0, 0, 0.05, 0), abs=1e-5)


def test_three_points_on_a_line_make_no_arc(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    start = pose_at(START)
    assert (
        arm.ask(Fsm.MOVEC, move_to(shifted(start, 0, 0, 0, 0, 0.02, 0), shifted(start, 0, 0, 0, 0, 0.04, 0)))
        is Fsm.JOINTCTRL
    )


def test_a_label_is_gone_to_and_an_unknown_one_is_not(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    assert arm.ask(Fsm.TOSTATE, "nowhere") is Fsm.JOINTCTRL
    arm.ask(Fsm.TOSTATE, "forward")
    arm.finish()
    assert arm.states.q[:6] == pytest.approx(LABELS["forward"])
    assert arm.fastest <= LABEL_SPEED + 1e-6


def test_a_saved_label_is_gone_to(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    arm.ask(Fsm.SAVESTATE, "mine")
    arm.finish()
    arm.ask(Fsm.TOSTATE, "forward")
    arm.finish()
    arm.ask(Fsm.TOSTATE, "mine")
    arm.finish()
    assert arm.states.q == pytest.approx(START)


def test_a_motion_can_be_broken_off(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    arm.ask(Fsm.TOSTATE, "forward")
    arm.run(0.3)
    assert arm.ask(Fsm.JOINTCTRL) is Fsm.JOINTCTRL
    there = arm.states.q
    arm.run(0.5)
    assert arm.states.q == pytest.approx(there)
    assert np.abs(there[:6] - LABELS["forward"]).max() > 0.1


def test_what_was_taught_by_hand_is_repeated(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    arm.ask(Fsm.TEACH, "wave")
    for i in range(200):
        q = START.copy()
        q[0] += 0.4 * np.sin(np.pi * i / 200)
        arm.states = JointStates(q=q)
        arm.run(0.01)
    assert not arm.told.kp.any()
    assert np.abs(arm.told.tau).max() > 1.0  # its weight is carried
    arm.ask(Fsm.JOINTCTRL)
    arm.ask(Fsm.TEACHREPEAT, "wave")
    seen = []
    while arm.controller.fsm is Fsm.TEACHREPEAT:
        arm.run(0.02)
        seen.append(arm.states.q[0] - START[0])
    assert max(seen) == pytest.approx(0.4, abs=0.005)
    assert len(seen) * 0.02 == pytest.approx(2.0, abs=0.3)
    assert arm.ask(Fsm.TEACHREPEAT, "unknown") is Fsm.JOINTCTRL


def test_calibration_makes_the_present_pose_the_zero_and_ends_in_passive(arm: IdealArm) -> None:
    arm.ask(Fsm.CALIBRATION)
    arm.run(0.1)
    assert arm.controller.fsm is Fsm.PASSIVE
    assert arm.controller.measured.q == pytest.approx([0, 0, 0, 0, 0, 0, START[6]])
    arm.ask(Fsm.JOINTCTRL)
    arm.run(0.1)
    assert arm.states.q == pytest.approx(START)


# --- Tracking -------------------------------------------------------------------------------------------------------


def test_tracking_catches_up_at_pi_radians_a_second(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    arm.ask(Fsm.INVALID, JointCommands(q=START + 0.5), track=True)
    arm.run(0.1)
    assert arm.states.q - START == pytest.approx(np.full(7, 0.1 * np.pi))
    arm.run(0.1)
    assert arm.states.q == pytest.approx(START + 0.5)


def test_tracking_has_no_position_limit(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    q = START.copy()
    q[0] = 5.0
    arm.ask(Fsm.INVALID, JointCommands(q=q), track=True)
    arm.run(2.0)
    assert arm.states.q[0] == pytest.approx(5.0)


def test_a_client_that_is_gone_leaves_an_arm_that_goes_to_the_last_target_and_holds_it(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    arm.ask(Fsm.INVALID, JointCommands(q=START - 0.4, dq=np.full(7, -0.5)), track=True)
    arm.run(30.0)
    assert arm.controller.fsm is Fsm.JOINTCTRL
    assert arm.told.q == pytest.approx(START - 0.4)
    assert not arm.told.dq.any()


def test_a_command_that_is_not_tracked_moves_nothing(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    arm.ask(Fsm.INVALID, JointCommands(q=START + 0.5))
    arm.run(0.5)
    assert arm.states.q == pytest.approx(START)


def test_the_commanded_speed_reaches_the_motors_up_to_the_limit(arm: IdealArm) -> None:
    arm.ask(Fsm.JOINTCTRL)
    arm.ask(Fsm.INVALID, JointCommands(q=START, dq=np.array([0.3, 50, 0, 0, 0, 0, 0])), track=True)
    arm.run(0.002)
    assert arm.told.dq == pytest.approx([0.3, np.pi, 0, 0, 0, 0, 0])
    assert (arm.told.kp == KP_JOINTCTRL).all()
    assert (arm.told.kd == KD_JOINTCTRL).all()


def test_a_tracked_pose_is_followed_and_one_out_of_reach_is_not(arm: IdealArm) -> None:
    arm.ask(Fsm.CARTESIAN)
    goal = shifted(pose_at(START), 0, 0, 0.05, 0, 0.02, 0.01)
    arm.ask(Fsm.INVALID, move_to(goal, gripper=-0.7), track=True)
    arm.run(0.5)
    assert arm.pose == pytest.approx(goal, abs=1e-6)
    assert arm.states.q[6] == pytest.approx(-0.7)
    for far in (2.0, 1e200):
        arm.ask(Fsm.INVALID, move_to(np.array([0, 0, 0, far, 0, 0])), track=True)
        arm.run(0.2)
    assert arm.pose == pytest.approx(goal, abs=1e-6)
    assert arm.controller.fsm is Fsm.CARTESIAN


# --- PASSIVE and LOWCMD ---------------------------------------------------------------------------------------------


def test_passive_is_damped_and_nothing_else(arm: IdealArm) -> None:
    arm.run(0.01)
    assert not arm.told.kp.any()
    assert not arm.told.tau.any()
    assert (arm.told.kd == KD_PASSIVE).all()


def test_lowcmd_clamps_position_and_speed_but_no_torque_and_repeats_itself_for_ever(arm: IdealArm) -> None:
    wish = JointCommands(q=np.full(7, 9.0), dq=np.full(7, 50.0), tau=np.full(7, 700.0), kp=KP_JOINTCTRL, kd=KD_PASSIVE)
    arm.ask(Fsm.LOWCMD, wish)
    arm.run(10.0)
    assert arm.controller.fsm is Fsm.LOWCMD
    assert arm.told.q == pytest.approx(z1.Q_MAX)
    assert arm.told.dq == pytest.approx(z1.DQ_MAX)
    assert (arm.told.tau == 700.0).all()
    assert arm.told.kp == pytest.approx(KP_JOINTCTRL)


def test_out_of_lowcmd_the_arm_is_held_where_it_is(arm: IdealArm) -> None:
    arm.ask(Fsm.LOWCMD, JointCommands(q=START))
    arm.states = JointStates(q=START - 0.3)
    arm.run(0.01)
    assert arm.ask(Fsm.JOINTCTRL) is Fsm.JOINTCTRL
    arm.run(0.5)
    assert arm.states.q == pytest.approx(START - 0.3)


def test_a_body_that_is_not_finite_changes_nothing(arm: IdealArm) -> None:
    broken = bytearray(encode_command(Fsm.LOWCMD))
    broken[7:11] = np.float32(np.nan).tobytes()
    with pytest.raises(ProtocolError, match="must be finite"):
        arm.controller.obey(decode_command(bytes(broken)))
    assert arm.controller.fsm is Fsm.PASSIVE
    arm.ask(Fsm.JOINTCTRL)
    with pytest.raises(ProtocolError, match="a label is"):
        arm.controller.obey(decode_command(encode_command(Fsm.TOSTATE)))
    assert arm.controller.fsm is Fsm.JOINTCTRL


# --- On the twin's physics ------------------------------------------------------------------------------------------


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
    twin.take(encode_command(Fsm.JOINTCTRL))
    assert np.abs(run(twin, 0.5) - before).max() < 0.01
    goal = pose_at(LABELS["forward"])
    twin.take(encode_command(Fsm.MOVEJ, move_to(goal, gripper=-1.0, speed=1.5)))
    fastest = 0.0
    while twin.controller.fsm is Fsm.MOVEJ:
        run(twin, 0.01)
        fastest = max(fastest, float(np.abs(twin.world.read_arm()[1]).max()))
    assert fastest < 1.6
    run(twin, 0.5)
    assert postureToHomo(twin.controller.answer().pose) == pytest.approx(postureToHomo(goal), abs=0.01)


def test_a_torque_beyond_the_motors_is_passed_on_and_ends_at_their_effort_limit(twin: ControlledWorld) -> None:
    tau = np.zeros(7)
    tau[0] = 700.0
    twin.take(encode_command(Fsm.LOWCMD, JointCommands(q=twin.world.read_arm()[0], tau=tau)))
    run(twin, 0.01)
    assert twin.world.read_arm()[2][0] == pytest.approx(z1.TAU_MAX[0])


def test_every_second_answer_repeats_the_measurement(twin: ControlledWorld) -> None:
    twin.take(encode_command(Fsm.INVALID))
    run(twin, 0.1)
    answers = []
    for _ in range(40):
        run(twin, 0.002)
        answers.append(twin.answer())
    assert sum(a == b for a, b in pairwise(answers)) in (19, 20)


def test_a_silent_board_leaves_stale_answers_and_is_recovered_from(twin: ControlledWorld) -> None:
    twin.take(encode_command(Fsm.INVALID))  # in PASSIVE it sinks
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
    twin.take(encode_command(Fsm.LOWCMD, JointCommands(q=big, dq=-big, tau=-big, kp=big, kd=big)))
    run(twin, 0.5)
    twin.take(encode_command(Fsm.INVALID, JointCommands(kp=-big, kd=-big)))
    q = run(twin, 0.5)
    assert np.isfinite(q).all()
    assert twin.world.data.time > 0.9  # MuJoCo starts anew when it has lost its way
    assert not twin.world.data.warning.number.any()
    assert twin.handle(encode_command(Fsm.JOINTCTRL)) is not None


def test_random_bytes_and_mutilated_commands_are_counted_and_never_crash(twin: ControlledWorld) -> None:
    rng = np.random.default_rng(5)
    goods = [encode_command(state, bodies(state), track=bool(state % 2)) for state in Fsm]
    refused = 0
    for i in range(5000):
        data = bytearray(goods[rng.integers(len(goods))])
        for _ in range(rng.integers(1, 8)):
            data[rng.integers(len(data))] = rng.integers(256)
        data = (bytes(data), bytes(data[: rng.integers(147)]), rng.bytes(int(rng.integers(0, 400))))[i % 3]
        refused += not twin.take(data)
        if i % 10 == 0:
            run(twin, 0.002)
            assert len(twin.answer()) == 208
    assert twin.refused == refused > 3000
    assert twin.last_refusal
    assert np.isfinite(twin.world.read_arm()[0]).all()


def test_the_worlds_own_servos_take_over_again_from_motors_that_were_let_go(twin: ControlledWorld) -> None:
    twin.take(encode_command(Fsm.LOWCMD))  # neither stiffness nor torque: it falls
    q = run(twin, 0.1)
    assert np.abs(twin.world.read_arm()[1]).max() > 0.5
    twin.world.set_command(q, np.zeros(7))
    for _ in range(500):
        twin.world.step()
    assert np.abs(twin.world.read_arm()[0] - q).max() < 0.02
