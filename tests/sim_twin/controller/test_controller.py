"""State machine of the controller with ideal motors."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base import z1
from hal.z1_protocol.controller import KD_JOINTCTRL, KD_PASSIVE, KP_JOINTCTRL, LABELS, decode_command, encode_command
from hal.z1_protocol.motor_board import PERIOD_S
from hal.z1_protocol.records import JointCommands, JointStates
from hal.z1_protocol.states import MOVES, Fsm, is_granted
from sim_twin.controller.motion_planner import LABEL_SPEED
from tests.support.hal.ideal_arm import START, IdealArm, make_body, move_to, pose_at, shift

ONE_CYCLE = {Fsm.SAVESTATE, Fsm.CALIBRATION}
STATES = [state for state in Fsm if state not in {Fsm.INVALID, Fsm.SETTRAJ, Fsm.NEXT}]


@pytest.fixture
def arm() -> IdealArm:
    return IdealArm()


# --- The table ----------------------------------------------------------------------------------------------------


def bring_to(state: Fsm) -> IdealArm:
    arm = IdealArm()
    arm.controller.planner.recordings["known"] = np.linspace(START, START + 0.05, 20)
    if state is Fsm.PASSIVE:
        return arm
    if state not in (Fsm.LOWCMD, Fsm.CALIBRATION):
        arm.request(Fsm.JOINTCTRL)
    arm.request(state, make_body(state))
    assert arm.controller.fsm is state
    return arm


@pytest.mark.parametrize("present", [state for state in STATES if state not in ONE_CYCLE], ids=lambda s: s.name)
def test_every_request_is_granted_or_ignored_as_in_the_table(present: Fsm) -> None:
    for requested in Fsm:
        arm = bring_to(present)
        granted = requested if is_granted(present, requested) and requested is not Fsm.INVALID else present
        expected = Fsm.BACKTOSTART if granted is Fsm.NEXT else granted
        assert arm.request(requested, make_body(requested)) is expected, requested.name


@pytest.mark.parametrize("state", sorted(MOVES - {Fsm.TRAJECTORY}), ids=lambda s: s.name)
def test_every_motion_falls_back_to_joint_control_by_itself(state: Fsm) -> None:
    arm = bring_to(state)
    arm.finish()
    assert arm.controller.fsm is Fsm.JOINTCTRL


@pytest.mark.parametrize(
    ("state", "body"), [(Fsm.TOSTATE, "nowhere"), (Fsm.TEACHREPEAT, "nowhere"), (Fsm.SAVESTATE, "my pose")]
)
def test_a_state_without_a_motion_is_shown_for_one_cycle(arm: IdealArm, state: Fsm, body: str) -> None:
    arm.request(Fsm.JOINTCTRL)
    assert arm.request(state, body) is state
    arm.run(2 * PERIOD_S)
    assert arm.controller.fsm is Fsm.JOINTCTRL
    assert arm.states.q == pytest.approx(START)


def test_a_request_that_persists_is_granted_again_after_its_motion(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.command = decode_command(encode_command(Fsm.TOSTATE, "nowhere"))
    seen = []
    for _ in range(12):
        arm.run(PERIOD_S)
        seen.append(arm.controller.fsm)
    assert seen.count(Fsm.TOSTATE) >= 4


def test_a_motion_begins_with_the_body_that_is_the_newest_a_step_after_its_request(arm: IdealArm) -> None:
    """It is planned in the step after the grant, so that a single request may lose its body (measured)."""
    arm.request(Fsm.JOINTCTRL)
    arm.command = decode_command(encode_command(Fsm.MOVEJ, make_body(Fsm.MOVEJ)))
    arm.run(PERIOD_S)
    arm.command = decode_command(encode_command(Fsm.INVALID, JointCommands(q=START)))
    arm.run(PERIOD_S)
    assert arm.controller.fsm is Fsm.MOVEJ
    arm.run(2 * PERIOD_S)
    assert arm.controller.fsm is Fsm.JOINTCTRL
    assert arm.states.q == pytest.approx(START)


def test_back_to_start_may_begin_in_passive(arm: IdealArm) -> None:
    assert arm.request(Fsm.BACKTOSTART) is Fsm.BACKTOSTART
    arm.finish()
    assert arm.states.q[:6] == pytest.approx(LABELS["startFlat"])
    assert arm.states.q[6] == z1.GRIPPER_CLOSED


def test_a_label_leaves_the_gripper(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.TOSTATE, "show_mid")
    arm.finish()
    assert arm.states.q == pytest.approx(np.append(LABELS["show_mid"], START[6]))


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
        assert arm.request(state, move_to(np.array([0, 0, 0, far, 0, 0.4]), pose_at(START))) is state
        arm.run(2 * PERIOD_S)
        assert arm.controller.fsm is Fsm.JOINTCTRL
    arm.run(0.2)
    assert arm.states.q == pytest.approx(START)


def test_a_move_without_speed_takes_the_controllers_own(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.MOVEJ, move_to(pose_at(LABELS["show_right"]), speed=0.0))
    arm.finish()
    assert arm.max_speed == pytest.approx(1.0, abs=0.01)


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


def test_a_known_label_is_reached(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
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
        arm.run(0.012)
    assert not arm.commands.kp.any()
    assert np.abs(arm.commands.tau).max() > 1.0  # the weight is carried
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.TEACHREPEAT, "wave")
    replayed = []
    while arm.controller.fsm is Fsm.TEACHREPEAT:
        arm.run(0.02)
        replayed.append(arm.states.q[0] - START[0])
    assert max(replayed) == pytest.approx(0.4, abs=0.005)
    assert len(replayed) * 0.02 == pytest.approx(2.4, abs=0.3)


def test_calibration_makes_the_present_pose_the_zero_and_ends_in_passive(arm: IdealArm) -> None:
    assert arm.request(Fsm.CALIBRATION) is Fsm.CALIBRATION
    arm.run(0.1)
    assert arm.controller.fsm is Fsm.PASSIVE
    assert arm.controller.measured.q == pytest.approx([0, 0, 0, 0, 0, 0, START[6]])
    arm.request(Fsm.JOINTCTRL)
    arm.run(0.1)
    assert arm.states.q == pytest.approx(START)


# --- Tracking -----------------------------------------------------------------------------------------------------


def test_tracking_catches_up_at_pi_radians_a_second(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.track(JointCommands(q=START + 0.4))
    arm.run(0.1)
    assert arm.states.q - START == pytest.approx(np.full(7, 0.1 * np.pi))
    arm.run(0.1)
    assert arm.states.q == pytest.approx(START + 0.4)


def test_a_command_that_is_not_tracked_moves_nothing(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL, JointCommands(q=START + 0.5))
    arm.run(0.5)
    assert arm.states.q == pytest.approx(START)


def test_the_commanded_speed_reaches_the_motors_and_persists(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.track(JointCommands(q=START, dq=np.array([0.3, 50, 0, 0, 0, 0, 0])))
    arm.run(1.0)
    assert arm.commands.dq == pytest.approx([0.3, np.pi, 0, 0, 0, 0, 0])
    assert (arm.commands.kp == KP_JOINTCTRL).all()
    assert (arm.commands.kd == KD_JOINTCTRL).all()


def test_the_weight_is_carried_for_three_joints_alone(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    assert (arm.commands.tau[3:] == 0.0).all()
    assert np.abs(arm.commands.tau[1:3]).min() > 1.0


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
    arm.run(2.0)
    assert arm.controller.fsm is Fsm.LOWCMD
    assert arm.commands.q == pytest.approx(z1.Q_MAX)
    assert arm.commands.dq == pytest.approx(z1.DQ_MAX)
    assert (arm.commands.tau == 700.0).all()
    assert arm.commands.kp == pytest.approx(KP_JOINTCTRL)


def test_after_lowcmd_the_arm_is_held_at_the_last_command(arm: IdealArm) -> None:
    arm.request(Fsm.LOWCMD, JointCommands(q=START))
    arm.states = JointStates(q=START - 0.3)
    assert arm.request(Fsm.JOINTCTRL, JointCommands(q=START - 0.2)) is Fsm.JOINTCTRL
    arm.run(0.1)
    assert arm.states.q == pytest.approx(START - 0.2)


def test_a_request_without_a_body_in_lowcmd_is_obeyed_for_a_cycle_and_then_the_reference(arm: IdealArm) -> None:
    arm.request(Fsm.LOWCMD, JointCommands(q=START, kp=KP_JOINTCTRL))
    arm.command = decode_command(encode_command(Fsm.JOINTCTRL))
    arm.run(PERIOD_S)
    assert arm.controller.fsm is Fsm.LOWCMD
    assert not arm.commands.kp.any()
    arm.run(PERIOD_S)
    assert arm.controller.fsm is Fsm.JOINTCTRL
    assert (arm.commands.q == 0.0).all()
    assert (arm.commands.kp == KP_JOINTCTRL).all()


def test_a_body_that_is_not_finite_leaves_the_last_command(arm: IdealArm) -> None:
    arm.request(Fsm.LOWCMD, JointCommands(q=START))
    before = arm.commands
    broken = bytearray(encode_command(Fsm.INVALID))
    broken[7:11] = np.float32(np.nan).tobytes()
    arm.command = decode_command(bytes(broken))
    arm.run(0.1)
    assert arm.commands.q == pytest.approx(before.q)
    assert arm.controller.invalid_bodies == 1


def test_a_request_without_a_label_is_one_for_an_unknown_label(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    assert arm.request(Fsm.TOSTATE) is Fsm.TOSTATE
    arm.run(2 * PERIOD_S)
    assert arm.controller.fsm is Fsm.JOINTCTRL
    assert arm.controller.invalid_bodies == 1
