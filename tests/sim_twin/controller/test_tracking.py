"""Tracking of joints and of a twist by the controller, with ideal motors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hal.base import z1
from hal.base.z1_kinematics import pose_from_posture
from hal.z1_protocol.controller import KD_JOINTCTRL
from hal.z1_protocol.motor_board import PERIOD_S
from hal.z1_protocol.records import JointCommands
from hal.z1_protocol.states import Fsm
from sim_twin.controller.behaviours import KP_HOLDING, TWIST_JOINT_SPEED
from tests.support.hal.ideal_arm import START, IdealArm, move_to


@pytest.fixture
def arm() -> IdealArm:
    return IdealArm()


def test_tracking_catches_up_at_pi_radians_a_second(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.track(JointCommands(q=START - 0.4))
    arm.run(0.1)
    assert START - arm.states.q == pytest.approx(np.full(7, 0.1 * np.pi))
    arm.run(0.1)
    assert arm.states.q == pytest.approx(START - 0.4)


@pytest.mark.parametrize(("joint", "target"), [(0, 5.0), (0, -4.0), (2, 1.0), (5, 4.0)])
def test_a_target_beyond_a_limit_is_jumped_to_once_the_limit_is_passed(
    arm: IdealArm, joint: int, target: float
) -> None:
    arm.request(Fsm.JOINTCTRL)
    q = START.copy()
    q[joint] = target
    arm.track(JointCommands(q=q))
    steps = []
    while arm.states.q[joint] != pytest.approx(target):
        before = arm.states.q[joint]
        arm.run(PERIOD_S)
        steps.append(abs(arm.states.q[joint] - before))
    assert steps[:-1] == pytest.approx(np.full(len(steps) - 1, np.pi * PERIOD_S))
    assert steps[-1] > 10 * np.pi * PERIOD_S
    limit = z1.Q_MAX[joint] if target > 0 else z1.Q_MIN[joint]
    assert abs(before - limit) < 1.01 * np.pi * PERIOD_S
    arm.track(JointCommands(q=START))
    arm.run(0.1)
    assert abs(arm.states.q[joint] - target) == pytest.approx(0.1 * np.pi)


@pytest.mark.parametrize(("target", "reached"), [(-3.0, -1.57), (1.0, 0.0)])
def test_the_tracked_gripper_is_limited(arm: IdealArm, target: float, reached: float) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.track(JointCommands(q=np.append(START[:6], target)))
    arm.run(1.0)
    assert arm.states.q[6] == pytest.approx(reached)


def test_a_command_that_is_not_tracked_moves_nothing(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL, JointCommands(q=START + 0.5))
    arm.run(0.5)
    assert arm.states.q == pytest.approx(START)


def test_the_commanded_speed_reaches_the_motors_unlimited_and_persists(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.track(JointCommands(q=START, dq=np.array([0.3, 50, 0, 0, 0, 0, 0])))
    arm.run(1.0)
    assert arm.commands.dq == pytest.approx([0.3, 50, 0, 0, 0, 0, 0])
    assert (arm.commands.kp == KP_HOLDING).all()
    assert (arm.commands.kd == KD_JOINTCTRL).all()


def test_the_weight_is_carried_for_three_joints_alone(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    assert (arm.commands.tau[3:] == 0.0).all()
    assert np.abs(arm.commands.tau[1:3]).min() > 1.0


@pytest.mark.parametrize("axis", range(6))
def test_a_twist_moves_the_pivot_in_its_own_frame(arm: IdealArm, axis: int) -> None:
    arm.request(Fsm.CARTESIAN)
    before = pose_from_posture(arm.pose)
    twist = 0.1 * np.eye(6)[axis]
    arm.track(move_to(twist))
    arm.run(0.5)
    moved = np.linalg.inv(before) @ pose_from_posture(arm.pose)
    assert moved[:3, 3] == pytest.approx(0.5 * twist[3:], abs=1e-3)
    assert Rotation.from_matrix(moved[:3, :3]).as_rotvec() == pytest.approx(0.5 * twist[:3], abs=1e-3)
    arm.track(move_to(np.zeros(6)))
    arm.run(0.1)
    assert np.abs(arm.commands.dq).max() < 1e-9


def test_a_twist_is_slowed_down_to_the_speed_of_its_fastest_joint(arm: IdealArm) -> None:
    arm.request(Fsm.CARTESIAN)
    arm.track(move_to(np.array([4.0, 0, 0, 0, 0, 0])))
    arm.run(0.1)
    assert np.abs(arm.commands.dq).max() == pytest.approx(TWIST_JOINT_SPEED)


@pytest.mark.integration
def test_a_twist_out_of_reach_ends_in_holding(arm: IdealArm) -> None:
    arm.request(Fsm.CARTESIAN)
    arm.track(move_to(np.array([0, 0, 0, 0.5, 0, 0])))
    arm.run(3.0)
    assert arm.controller.fsm is Fsm.CARTESIAN
    assert np.abs(arm.commands.dq).max() < 1e-9
    assert (arm.states.q <= z1.Q_MAX).all()


def test_a_twist_moves_the_gripper_too(arm: IdealArm) -> None:
    arm.request(Fsm.CARTESIAN)
    arm.track(move_to(np.zeros(6), gripper=-9.0))
    arm.run(1.0)
    assert arm.states.q == pytest.approx(np.append(START[:6], -1.57))
