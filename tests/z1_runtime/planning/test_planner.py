"""Plans on analytic scenes: what is reachable gets a motion, what is not is refused for the right reason."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from hal.base import z1
from hal.base.transforms import pose_error
from models.types import GraspSet
from tests.support.tabletop_scenes import (
    HEIGHT_M,
    Q_START,
    camera_pose,
    cylinder,
    frontal,
    in_camera,
    make_observation,
    wall,
)
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.grasp_candidates import GraspCandidates
from z1_runtime.planning.planner import GraspPlanner, NoPlanError
from z1_runtime.planning.planner_config import PlannerConfig
from z1_runtime.types import Observation

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
    """Return frontal grasps of a cylinder at (x, y), all right by construction."""
    bearing = np.arctan2(y, x)
    grasps = [
        frontal(x, y, z, pitch, bearing + turn)
        for z in (0.09, 0.075, 0.11)
        for pitch in np.deg2rad([10, 20, 30, 40])
        for turn in np.deg2rad([0, -15, 15])
    ]
    return in_camera(observation.T_base_camera, grasps, width_m)


def refusals(planner: GraspPlanner, grasps: GraspSet, observation: Observation) -> list[tuple[str, str]]:
    with pytest.raises(NoPlanError) as caught:
        planner.plan(grasps, observation, Q_START)
    return [(rejection.reason, rejection.detail) for rejection in caught.value.rejections]


@pytest.mark.parametrize(("x", "y"), PLACES)
def test_a_standing_cylinder_is_planned_wherever_it_may_stand(planner, kinematics, x, y):
    observation = scene(kinematics, x, y)
    plan = planner.plan(candidates(observation, x, y), observation, Q_START)
    legs = (plan.transfer, plan.approach, plan.close, plan.lift)
    assert plan.transfer.q[0] == pytest.approx(Q_START)
    for before, after in pairwise(legs):
        assert after.q[0] == pytest.approx(before.q[-1], abs=1e-9)
    for leg in legs:
        assert (leg.q >= z1.Q_MIN - 1e-9).all()
        assert (leg.q <= z1.Q_MAX + 1e-9).all()
        assert (np.abs(leg.dq) <= z1.DQ_MAX).all()
    at_grasp = kinematics.pivot(plan.approach.q[-1, : z1.N_ARM])
    assert max(pose_error(at_grasp, plan.T_base_pivot)) < 1e-4
    lifted = kinematics.pivot(plan.lift.q[-1, : z1.N_ARM])
    assert lifted[:3, 3] - at_grasp[:3, 3] == pytest.approx([0.0, 0.0, planner.config.lift_m], abs=1e-4)
    back = kinematics.pivot(plan.approach.q[0, : z1.N_ARM])[:3, 3] - at_grasp[:3, 3]
    assert back / np.linalg.norm(back) == pytest.approx(-plan.T_base_grasp[:3, 2], abs=1e-3)
    assert plan.jaw_open < plan.jaw_contact < plan.close.q[-1, -1] <= 0.0
    assert plan.approach.q[-1, -1] == pytest.approx(plan.jaw_open)


def test_while_the_jaws_close_the_hand_turns_about_the_jaws_axis_and_stays_where_it_is(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    plan = planner.plan(candidates(observation, 0.48, 0.0), observation, Q_START)
    poses = np.array([kinematics.pivot(q[: z1.N_ARM]) for q in plan.close.q[::5]])
    assert poses[:, :3, 3] == pytest.approx(np.tile(poses[0, :3, 3], (len(poses), 1)), abs=5e-4)
    assert poses[:, :3, 1] == pytest.approx(np.tile(poses[0, :3, 1], (len(poses), 1)), abs=5e-3)
    turned_rad = np.arccos(np.clip(poses[:, :3, 0] @ poses[0, :3, 0], -1.0, 1.0))
    touching = plan.close.q[::5, -1] > plan.jaw_contact
    assert not touching[0]
    assert 0.05 < turned_rad[touching].min() <= turned_rad.max() < 0.3


def test_the_plan_keeps_its_distances_all_the_way(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.15, wall(0.60, 0.0))
    plan = planner.plan(candidates(observation, 0.48, 0.15), observation, Q_START)
    checker = CollisionChecker(kinematics, observation, Q_START)
    assert checker.check_trajectory(plan.transfer, threshold_m=0.004, object_threshold_m=0.004) is None
    assert checker.check_trajectory(plan.approach, threshold_m=0.002, object_threshold_m=0.001) is None
    assert checker.check_closing(plan.close) is None
    assert checker.check_trajectory(plan.lift, threshold_m=0.002) is None
    for leg in (plan.transfer, plan.approach, plan.lift):
        poses = np.array([kinematics.pivot(q[: z1.N_ARM]) for q in leg.q[::10]])
        assert checker.check_grippers(poses, leg.q[::10, -1]).height_m.min() >= checker.config.table_margin_m


def test_a_grasp_from_below_is_refused_for_the_table(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    below = in_camera(observation.T_base_camera, [frontal(0.48, 0.0, 0.06, np.deg2rad(-60))])
    [(reason, detail)] = refusals(planner, below, observation)
    assert reason == "table"
    assert "above the table" in detail


def test_a_grasp_from_behind_is_refused_for_its_joints(planner, kinematics):
    observation = scene(kinematics, 0.56, 0.0)
    behind = in_camera(observation.T_base_camera, [frontal(0.56, 0.0, 0.09, np.deg2rad(20), np.pi)])
    [(reason, _)] = refusals(planner, behind, observation)
    assert reason == "ik"


def test_an_object_too_wide_is_refused_with_figures(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    [(reason, detail), *_] = refusals(planner, candidates(observation, 0.48, 0.0, width_m=0.110), observation)
    assert reason == "width"
    assert "118 mm wide" in detail  # said to be 110, and its sides are not seen


def test_a_neighbour_where_the_jaws_would_go_is_refused_as_scene(planner, kinematics):
    T_base_camera = camera_pose(kinematics)
    neighbours = [cylinder(0.48, side * 0.075, T_base_camera[:3, 3]) for side in (-1.0, 1.0)]
    observation = scene(kinematics, 0.48, 0.0, *neighbours)
    reasons = refusals(planner, in_camera(T_base_camera, [frontal(0.48, 0.0, 0.09, np.deg2rad(20))]), observation)
    assert [reason for reason, _ in reasons] == ["scene"]


def test_a_grasp_that_would_push_the_object_is_refused_as_object(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    beside = frontal(0.48, 0.0, 0.09, np.deg2rad(20))
    beside[1, 3] += 0.030
    [(reason, _)] = refusals(planner, in_camera(observation.T_base_camera, [beside]), observation)
    assert reason == "object"


def test_a_wall_before_the_object_leaves_no_way(planner, kinematics):
    observation = scene(kinematics, 0.56, 0.0, wall(0.42, 0.0, height=0.45))
    reasons = refusals(planner, candidates(observation, 0.56, 0.0), observation)
    assert {"scene"} <= {reason for reason, _ in reasons} <= {"scene", "path", "ik", "self", "width"}


def test_the_first_that_passes_is_taken_and_the_refused_are_reported(planner, kinematics):
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
    alone, plan = planner.plan(good, observation, Q_START), planner.plan(both, observation, Q_START)
    assert plan.rank == alone.rank + 2
    assert [rejection.rank for rejection in plan.rejections] == list(range(plan.rank))
    assert [rejection.reason for rejection in plan.rejections[:2]] == ["table", "ik"]
    assert plan.approach.q == pytest.approx(alone.approach.q)


JUST_OUT_OF_REACH = (0.48, 0.0, 0.089, 0.20, -0.845)


def test_a_grasp_just_out_of_reach_is_planned_within_the_paper_s_tolerance(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    grasps = in_camera(observation.T_base_camera, [frontal(*JUST_OUT_OF_REACH)])
    plan = planner.plan(grasps, observation, Q_START)
    assert plan.ik_method == "least_squares"
    assert plan.rejections == ()
    at_grasp = kinematics.pivot(plan.approach.q[-1, : z1.N_ARM])
    assert max(pose_error(at_grasp, plan.T_base_pivot)) < 1e-4
    checker = CollisionChecker(kinematics, observation, Q_START)
    wished = GraspCandidates(grasps, observation.T_base_camera, planner.gripper, checker, fallback_width_m=0.06).ways(0)
    assert isinstance(wished, list)
    assert not any(kinematics.solve(way.T_base_pivot) for way in wished)
    errors = [pose_error(at_grasp, way.T_base_pivot) for way in wished]
    assert any(0.0 < away_m <= 0.002 and turned_rad <= np.deg2rad(1.0) for away_m, turned_rad in errors)
    for leg in (plan.transfer, plan.approach, plan.close, plan.lift):
        assert (leg.q >= z1.Q_MIN).all()
        assert (leg.q <= z1.Q_MAX).all()


def test_a_grasp_within_reach_goes_before_a_better_one_within_tolerance(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    both = in_camera(
        observation.T_base_camera,
        [frontal(*JUST_OUT_OF_REACH), frontal(0.48, 0.0, 0.09, np.deg2rad(20))],
    )
    plan = planner.plan(both, observation, Q_START)
    assert (plan.rank, plan.ik_method) == (1, "analytic")
    assert [rejection.reason for rejection in plan.rejections] == ["ik"]


def test_least_squares_comes_last_is_bounded_and_says_how_far_away_it_stayed(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    far = frontal(0.9, 0.0, 0.09, 0.4)
    grasps = in_camera(observation.T_base_camera, [far, frontal(*JUST_OUT_OF_REACH), far])
    plan = planner.plan(grasps, observation, Q_START)
    assert (plan.rank, plan.ik_method) == (1, "least_squares")
    assert [rejection.rank for rejection in plan.rejections] == [0, 2]
    assert "allowed is 2 mm and 1°. (least squares)" in plan.rejections[0].detail
    assert "least squares" not in plan.rejections[1].detail
    tight = GraspPlanner(kinematics, PlannerConfig(max_least_squares=1))  # spent on the first
    assert [reason for reason, _ in refusals(tight, grasps, observation)] == ["ik"] * 3


def test_unknown_widths_are_measured_in_the_cloud(planner, kinematics):
    observation = scene(kinematics, 0.48, 0.0)
    unsaid = candidates(observation, 0.48, 0.0, width_m=np.nan)
    plan = planner.plan(unsaid, observation, Q_START)
    assert plan.width_m == pytest.approx(0.060, abs=0.004)


def test_no_candidates_and_a_spent_budget_are_said_plainly(kinematics, planner):
    observation = scene(kinematics, 0.48, 0.0)
    nothing = GraspSet(T_camera_grasps=np.empty((0, 4, 4)), scores=np.empty(0), widths_m=np.empty(0))
    with pytest.raises(NoPlanError, match="none of 0 candidates"):
        planner.plan(nothing, observation, Q_START)
    far = in_camera(observation.T_base_camera, [frontal(0.9, 0.0, HEIGHT_M / 2, 0.4)] * 5)
    with pytest.raises(NoPlanError, match=r"none of 5 candidates can be executed: 5 ik"):
        planner.plan(far, observation, Q_START)
    walled = scene(kinematics, 0.56, 0.0, wall(0.37, 0.0, height=0.45))
    with pytest.raises(NoPlanError, match=r"not tried, the search budget \(max_tried\) was spent"):
        GraspPlanner(kinematics, PlannerConfig(max_tried=1)).plan(candidates(walled, 0.56, 0.0), walled, Q_START)


def test_a_configuration_that_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match="short_standoff_m <= standoff_m"):
        PlannerConfig(standoff_m=0.05, short_standoff_m=0.06)
    with pytest.raises(ValueError, match="max_least_squares is -1"):
        PlannerConfig(max_least_squares=-1)
    with pytest.raises(ValueError, match="raise_m is nan"):
        PlannerConfig(raise_m=float("nan"))
