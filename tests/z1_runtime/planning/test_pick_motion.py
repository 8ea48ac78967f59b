"""Motions of single placements: the phases fit together, and an infeasible one is a rejection with its stage."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.base import z1
from tests.support.tabletop_scenes import Q_START, camera_pose, cylinder, frontal, make_checker, make_observation, wall
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.beak_gripper import BeakGripper, GripperPlacement, WidthError
from z1_runtime.motion.limits import MotionLimits
from z1_runtime.planning.config import PlannerConfig
from z1_runtime.planning.pick_motion import PickMotion, PickMotionPlanner
from z1_runtime.types import PlanningStage, Rejection, RejectionReason

KINEMATICS, GRIPPER = Kinematics(), BeakGripper()


def planner(checker: CollisionChecker) -> PickMotionPlanner:
    return PickMotionPlanner(
        KINEMATICS,
        checker,
        Q_START,
        config=PlannerConfig(),
        limits=MotionLimits(),
        timer=lambda _: nullcontext(),
    )


@pytest.fixture(scope="module")
def in_the_open() -> PickMotionPlanner:
    T_base_camera = camera_pose(KINEMATICS)
    elsewhere = cylinder(0.48, 0.35, T_base_camera[:3, 3])
    return planner(make_checker(KINEMATICS, make_observation(T_base_camera, elsewhere)))


def place(width_m: float = 0.06, *pose: float) -> list[GripperPlacement]:
    T_base_grasp = frontal(*(pose or (0.48, 0.0, 0.09, 0.35)))
    flips = GRIPPER.fit(T_base_grasp, width_m)
    return [flips[1], flips[0]]  # the camera above the gripper first


def test_a_feasible_placement_gets_a_motion_of_that_placement(in_the_open):
    placements = place()
    motion = in_the_open.plan_first(placements)
    assert isinstance(motion, PickMotion)
    assert motion.placement is placements[0]
    np.testing.assert_array_equal(motion.transfer.q[0], Q_START)
    for before, after in (
        (motion.transfer, motion.approach),
        (motion.approach, motion.close),
        (motion.close, motion.lift),
    ):
        np.testing.assert_allclose(after.q[0], before.q[-1], atol=1e-9)


def test_a_placement_out_of_reach_is_rejected_at_the_inverse_kinematics(in_the_open):
    rejection = in_the_open.plan_first(place(0.06, 0.9, 0.0, 0.09, 0.35))
    assert isinstance(rejection, Rejection)
    assert (rejection.reason, rejection.stage) == (RejectionReason.IK, PlanningStage.IK)


def test_a_blocked_approach_is_rejected_at_that_stage():
    T_base_camera = camera_pose(KINEMATICS)
    points = cylinder(0.56, 0.0, T_base_camera[:3, 3])
    walled = planner(make_checker(KINEMATICS, make_observation(T_base_camera, points, wall(0.42, 0.0, height=0.45))))
    rejection = walled.plan_first(place(0.06, 0.56, 0.0, 0.09, 0.35))
    assert isinstance(rejection, Rejection)
    assert (rejection.reason, rejection.stage) == (RejectionReason.SCENE, PlanningStage.APPROACH)


def test_the_least_squares_pose_is_only_used_without_an_exact_solution(in_the_open):
    reachable, far = place()[0], place(0.06, 0.9, 0.0, 0.09, 0.35)[0]
    assert in_the_open.nearest_reachable(reachable) is None
    rejection = in_the_open.nearest_reachable(far)
    assert isinstance(rejection, Rejection)
    assert rejection.reason is RejectionReason.IK


@pytest.mark.integration
@settings(max_examples=25, deadline=None)
@given(
    st.one_of(st.floats(1e-4, 0.018), st.floats(0.075, 0.1)),
    st.tuples(st.floats(0.36, 0.62), st.floats(-0.2, 0.2), st.floats(0.0, 0.2), st.floats(-0.3, 1.5)),
)
def test_widths_at_the_edges_of_the_jaw_range_and_random_poses_never_raise(in_the_open, width_m, pose):
    try:
        placements = place(width_m, *pose)
    except WidthError:
        return  # too wide, which the candidates reject
    found = in_the_open.plan_first(placements)
    if isinstance(found, PickMotion):
        for phase in (found.transfer, found.approach, found.close, found.lift):
            assert ((phase.q >= z1.Q_MIN) & (phase.q <= z1.Q_MAX)).all()


def test_a_jaw_angle_a_hair_beyond_closed_is_clipped(in_the_open):
    placement = replace(place(0.012)[0], jaw_touch=0.0017)
    motion = in_the_open.plan_first([placement])
    assert isinstance(motion, PickMotion)
    assert motion.close.q.max(axis=0)[-1] == z1.GRIPPER_CLOSED
