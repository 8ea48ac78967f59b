"""State machine of the controller with ideal motors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from hal.z1_protocol.controller import KD_PASSIVE, KP_JOINTCTRL, LABELS, decode_command, encode_command
from hal.z1_protocol.motor_board import PERIOD_S
from hal.z1_protocol.records import JointCommands, JointStates, MotorError
from hal.z1_protocol.states import MOVES, Fsm, is_granted
from sim_twin.controller.behaviours import KP_HOLDING
from sim_twin.controller.controller import CALIBRATION_S
from sim_twin.controller.motion_planner import LABEL_SPEED
from tests.support.hal.ideal_arm import START, IdealArm, make_body

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
        seen = arm.request(requested, make_body(requested))
        if (present, requested) == (Fsm.PASSIVE, Fsm.CALIBRATION):  # shown after the board's answer alone
            arm.run(CALIBRATION_S)
            seen = arm.controller.fsm
        assert seen is expected, requested.name


@pytest.mark.integration
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


# --- Labels, lessons and the zero -----------------------------------------------------------------------------------


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
    assert arm.request(Fsm.CALIBRATION) is Fsm.PASSIVE
    arm.run(CALIBRATION_S)
    assert arm.controller.fsm is Fsm.CALIBRATION
    arm.run(0.1)
    assert arm.controller.fsm is Fsm.PASSIVE
    assert arm.controller.measured.q == pytest.approx([0, 0, 0, 0, 0, 0, START[6]])
    arm.request(Fsm.JOINTCTRL)
    arm.run(0.1)
    assert arm.states.q == pytest.approx(START)


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
    assert (arm.commands.kp == KP_HOLDING).all()


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


# --- Faults -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bit", [MotorError.OVER_CURRENT, MotorError.LEAKAGE, MotorError.OVERHEAT])
def test_a_motors_error_lets_the_arm_go_limp(arm: IdealArm, bit: MotorError) -> None:
    arm.request(Fsm.JOINTCTRL)
    error = np.zeros((7, 2), dtype=np.uint8)
    error[2, 0] = bit
    arm.states = replace(arm.states, error=error)
    arm.run(2 * PERIOD_S)
    assert arm.controller.fsm is Fsm.PASSIVE
    assert arm.request(Fsm.JOINTCTRL) is Fsm.PASSIVE


def test_other_error_bits_and_a_lost_motor_change_nothing(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.states = replace(arm.states, error=np.full((7, 2), 0x68, np.uint8), link=np.ones((7, 2), np.uint8))
    arm.run(0.1)
    assert arm.controller.fsm is Fsm.JOINTCTRL


def test_a_silent_board_lets_the_arm_go_limp_after_a_while(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    for steps, expected in ((400, Fsm.JOINTCTRL), (200, Fsm.PASSIVE)):
        for _ in range(steps):
            arm.controller.step(arm.command, arm.states, PERIOD_S)
        assert arm.controller.fsm is expected
