"""Plans on analytic scenes: reachable grasps get a motion, the others are rejected for the right reason."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.transforms import pose_error
from models.types import GraspSet
from tests.support.errors import raises
from tests.support.tabletop_scenes import (
    HEIGHT_M,
    Q_START,
    camera_pose,
    cylinder,
    frontal,
    in_camera,
    make_candidates,
    make_checker,
    make_observation,
    wall,
)
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.planning.config import PlannerConfig
from z1_runtime.planning.planner import GraspPlanner, NoPlanError
from z1_runtime.types import GraspPlan, Observation, PlanningStage, RejectionReason

PLACES = [(x, y) for x in (0.40, 0.48, 0.56) for y in (-0.15, 0.0, 0.15)]


@pytest.fixture(scope="module")
def kinematics() -> Kinematics:
    return Kinematics()


@pytest.fixture(scope="module")
def planner(kinematics) -> GraspPlanner:
    return GraspPlanner(kinematics)


def scene(kinematics: Kinematics, x: float, y: float, *obstacles: np.ndarray) -> Observation:
    T_base_camera = camera_pose(kinematics)
    return make_observation(T_base_camera, cylinder(x, y, T_base_camera[:3, 3]), *obstacles)


def candidates(observation: Observation, x: float, y: float, width_m: float = 0.06) -> GraspSet:
    """Return frontal grasps of a cylinder at (x, y), all feasible by construction."""
    bearing = np.arctan2(y, x)
    grasps = [
        frontal(x, y, z, pitch, bearing + turn)
        for z in (0.09, 0.075, 0.11)
        for pitch in np.deg2rad([10, 20, 30, 40])
        for turn in np.deg2rad([0, -15, 15])
    ]
    return in_camera(observation.T_base_camera, grasps, width_m)


def plan_first(planner: GraspPlanner, grasps: GraspSet, observation: Observation) -> GraspPlan:
    return planner.plan(make_candidates(planner._kinematics, grasps, observation, planner.config), Q_START)


def rejections(planner: GraspPlanner, grasps: GraspSet, observation: Observation) -> list[tuple[str, str]]:
    with raises(NoPlanError, "no_plan") as caught:
        plan_first(planner, grasps, observation)
    return [(rejection.reason.value, rejection.detail) for rejection in caught.value.rejections]


@pytest.mark.parametrize(("x", "y"), PLACES)
def test_an_upright_cylinder_is_planned_at_every_place(planner, kinematics, x, y):
    observation = scene(kinematics, x, y)
    plan = plan_first(planner, candidates(observation, x, y), observation)
    phases = (plan.transfer, plan.approach, plan.close, plan.lift)
    assert plan.transfer.q[0] == pytest.approx(Q_START)
    for before, after in pairwise(phases):
        assert after.q[0] == pytest.approx(before.q[-1], abs=1e-9)
    for phase in phases:
        assert (phase.q >= z1.Q_MIN - 1e-9).all()
        assert (phase.q <= z1.Q_MAX + 1e-9).all()
        assert (np.abs(phase.dq) <= z1.DQ_MAX).all()
    at_grasp = kinematics.pivot(plan.approach.q[-1, : z1.N_ARM])
    assert max(pose_error(at_grasp, plan.T_base_pivot)) < 1e-4
    lifted = kinematics.pivot(plan.lift.q[-1, : z1.N_ARM])
    assert lifted[:3, 3] - at_grasp[:3, 3] == pytest.approx([0.0, 0.0, planner.config.lift_m], abs=1e-4)
    back = kinematics.pivot(plan.approach.q[0, : z1.N_ARM])[:3, 3] - at_grasp[:3, 3]
    assert back / np.linalg.norm(back) == pytest.approx(-plan.T_base_grasp[:3, 2], abs=1e-3)
    assert plan.jaw_open < plan.jaw_contact < plan.close.q[-1, -1] <= 0.0
    assert plan.approach.q[-1, -1] == pytest.approx(plan.jaw_open)


def test_while_the_jaws_close_the_gripper_turns_about_their_axis_in_place(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    plan = plan_first(planner, candidates(observation, 0.48, 0.0), observation)
    poses = np.array([kinematics.pivot(q[: z1.N_ARM]) for q in plan.close.q[::5]])
    assert poses[:, :3, 3] == pytest.approx(np.tile(poses[0, :3, 3], (len(poses), 1)), abs=5e-4)
    assert poses[:, :3, 1] == pytest.approx(np.tile(poses[0, :3, 1], (len(poses), 1)), abs=5e-3)
    turned_rad = np.arccos(np.clip(poses[:, :3, 0] @ poses[0, :3, 0], -1.0, 1.0))
    touching = plan.close.q[::5, -1] > plan.jaw_contact
    assert not touching[0]
    assert 0.05 < turned_rad[touching].min() <= turned_rad.max() < 0.3


def test_the_plan_keeps_its_distances_all_the_way(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.15, wall(0.60, 0.0))
    plan = plan_first(planner, candidates(observation, 0.48, 0.15), observation)
    checker = make_checker(kinematics, observation)
    assert checker.check_trajectory(plan.transfer, threshold_m=0.004, object_threshold_m=0.004) is None
    assert checker.check_trajectory(plan.approach, threshold_m=0.002, object_threshold_m=0.001) is None
    assert checker.check_closing(plan.close) is None
    assert checker.check_trajectory(plan.lift, threshold_m=0.002) is None
    for phase in (plan.transfer, plan.approach, plan.lift):
        poses = np.array([kinematics.pivot(q[: z1.N_ARM]) for q in phase.q[::10]])
        assert checker.check_grippers(poses, phase.q[::10, -1]).height_m.min() >= checker.config.table_margin_m


def test_a_grasp_from_below_is_rejected_for_the_table(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    below = in_camera(observation.T_base_camera, [frontal(0.48, 0.0, 0.06, np.deg2rad(-60))])
    [(reason, detail)] = rejections(planner, below, observation)
    assert reason == "table"
    assert "above the table" in detail


def test_a_grasp_from_behind_is_rejected_for_its_joints(planner, kinematics):
    observation = scene(kinematics, 0.56, 0.0)
    behind = in_camera(observation.T_base_camera, [frontal(0.56, 0.0, 0.09, np.deg2rad(20), np.pi)])
    [(reason, _)] = rejections(planner, behind, observation)
    assert reason == "ik"


def test_an_object_too_wide_is_rejected_with_figures(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    [(reason, detail), *_] = rejections(planner, candidates(observation, 0.48, 0.0, width_m=0.110), observation)
    assert reason == "width"
    assert "118 mm wide" in detail  # given as 110, and its sides are not observed


def test_a_neighbour_in_the_jaws_path_is_rejected_as_scene(planner, kinematics):
    T_base_camera = camera_pose(kinematics)
    neighbours = [cylinder(0.48, side * 0.075, T_base_camera[:3, 3]) for side in (-1.0, 1.0)]
    observation = scene(kinematics, 0.48, 0.0, *neighbours)
    reasons = rejections(planner, in_camera(T_base_camera, [frontal(0.48, 0.0, 0.09, np.deg2rad(20))]), observation)
    assert [reason for reason, _ in reasons] == ["scene"]


def test_a_grasp_that_would_push_the_object_is_rejected_as_object(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    off_centre = frontal(0.48, 0.0, 0.09, np.deg2rad(20))
    off_centre[1, 3] += 0.030
    [(reason, _)] = rejections(planner, in_camera(observation.T_base_camera, [off_centre]), observation)
    assert reason == "object"


@pytest.mark.integration
def test_a_wall_before_the_object_blocks_every_grasp(planner, kinematics):
    observation = scene(kinematics, 0.56, 0.0, wall(0.42, 0.0, height=0.45))
    reasons = rejections(planner, candidates(observation, 0.56, 0.0), observation)
    assert {"scene"} <= {reason for reason, _ in reasons} <= {"scene", "path", "ik", "self", "width"}


def test_the_first_that_passes_is_taken_and_the_rejections_are_reported(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    good = candidates(observation, 0.48, 0.0)
    bad = in_camera(
        observation.T_base_camera,
        [frontal(0.48, 0.0, 0.06, np.deg2rad(-60)), frontal(0.9, 0.0, 0.09, np.deg2rad(20))],
    )
    both = GraspSet(
        T_camera_grasps=np.concatenate([bad.T_camera_grasps, good.T_camera_grasps]),
        scores=np.ones(len(bad) + len(good)),
        widths_m=np.concatenate([bad.widths_m, good.widths_m]),
    )
    alone, plan = plan_first(planner, good, observation), plan_first(planner, both, observation)
    assert plan.rank == alone.rank + 2
    assert [rejection.rank for rejection in plan.rejections] == list(range(plan.rank))
    assert [rejection.reason for rejection in plan.rejections[:2]] == [RejectionReason.TABLE, RejectionReason.IK]
    assert [rejection.stage for rejection in plan.rejections[:2]] == [PlanningStage.GRASP, PlanningStage.IK]
    assert plan.approach.q == pytest.approx(alone.approach.q)


JUST_OUT_OF_REACH = (0.48, 0.0, 0.089, 0.20, -0.845)


def test_a_grasp_just_out_of_reach_is_planned_within_the_paper_s_tolerance(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    grasps = in_camera(observation.T_base_camera, [frontal(*JUST_OUT_OF_REACH)])
    plan = plan_first(planner, grasps, observation)
    assert plan.ik_method == "least_squares"
    assert plan.rejections == ()
    at_grasp = kinematics.pivot(plan.approach.q[-1, : z1.N_ARM])
    assert max(pose_error(at_grasp, plan.T_base_pivot)) < 1e-4
    placements = make_candidates(kinematics, grasps, observation).placements(0).placements
    assert len(placements) > 0
    assert not any(kinematics.solve(placement.T_base_pivot) for placement in placements)
    errors = [pose_error(at_grasp, placement.T_base_pivot) for placement in placements]
    assert any(0.0 < error_m <= 0.002 and error_rad <= np.deg2rad(1.0) for error_m, error_rad in errors)
    for phase in (plan.transfer, plan.approach, plan.close, plan.lift):
        assert (phase.q >= z1.Q_MIN).all()
        assert (phase.q <= z1.Q_MAX).all()


def test_a_grasp_within_reach_goes_before_a_better_one_within_tolerance(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    both = in_camera(
        observation.T_base_camera,
        [frontal(*JUST_OUT_OF_REACH), frontal(0.48, 0.0, 0.09, np.deg2rad(20))],
    )
    plan = plan_first(planner, both, observation)
    assert (plan.rank, plan.ik_method) == (1, "analytic")
    assert [rejection.reason for rejection in plan.rejections] == ["ik"]


def test_least_squares_comes_last_is_bounded_and_reports_its_error(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    far = frontal(0.9, 0.0, 0.09, 0.4)
    grasps = in_camera(observation.T_base_camera, [far, frontal(*JUST_OUT_OF_REACH), far])
    plan = plan_first(planner, grasps, observation)
    assert (plan.rank, plan.ik_method) == (1, "least_squares")
    assert [rejection.rank for rejection in plan.rejections] == [0, 2]
    assert "allowed is 2 mm and 1°. (least squares)" in plan.rejections[0].detail
    assert "least squares" not in plan.rejections[1].detail
    tight = GraspPlanner(kinematics, PlannerConfig(max_least_squares=1))  # spent on the first
    assert [reason for reason, _ in rejections(tight, grasps, observation)] == ["ik"] * 3


def test_unknown_widths_are_measured_in_the_cloud(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    unknown = candidates(observation, 0.48, 0.0, width_m=np.nan)
    plan = plan_first(planner, unknown, observation)
    assert plan.width_m == pytest.approx(0.060, abs=0.004)


def test_no_candidates_and_a_spent_budget_are_named_in_the_error(kinematics, planner):
    observation = scene(kinematics, 0.48, 0.0)
    nothing = GraspSet(T_camera_grasps=np.empty((0, 4, 4)), scores=np.empty(0), widths_m=np.empty(0))
    with raises(NoPlanError, "no_plan") as caught:
        plan_first(planner, nothing, observation)
    assert caught.value.rejections == ()
    far = in_camera(observation.T_base_camera, [frontal(0.9, 0.0, HEIGHT_M / 2, 0.4)] * 5)
    with raises(NoPlanError, "no_plan") as caught:
        plan_first(planner, far, observation)
    assert "none of 5 candidates can be executed: 5 ik" in str(caught.value)
    assert [rejection.rank for rejection in caught.value.rejections] == list(range(5))
    walled = scene(kinematics, 0.56, 0.0, wall(0.37, 0.0, height=0.45))
    grasps = candidates(walled, 0.56, 0.0)
    with raises(NoPlanError, "no_plan") as caught:
        plan_first(GraspPlanner(kinematics, PlannerConfig(max_tried=1)), grasps, walled)
    assert len(caught.value.rejections) < len(grasps)


def test_an_invalid_configuration_is_rejected():
    with raises(InvalidValueError, "invalid_value"):
        PlannerConfig(standoff_m=0.05, short_standoff_m=0.06)
    with raises(InvalidValueError, "invalid_value"):
        PlannerConfig(max_least_squares=-1)
    with raises(InvalidValueError, "invalid_value"):
        PlannerConfig(raise_m=float("nan"))
