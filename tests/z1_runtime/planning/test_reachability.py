"""Ranking by reachability: feasible grasps go first, whatever their score."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base.errors import InvalidValueError
from models.obb.obb import OrientedBox
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
)
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.ranking import fit_upright_box
from z1_runtime.planning.config import PlannerConfig, ReachabilityConfig
from z1_runtime.planning.planner import GraspPlanner
from z1_runtime.planning.reachability import ReachabilityRanker
from z1_runtime.types import Observation

AT = (0.48, 0.0)
GOOD = frontal(*AT, 0.085, np.deg2rad(20))


@pytest.fixture(scope="module")
def planner() -> GraspPlanner:
    return GraspPlanner(Kinematics())


@pytest.fixture(scope="module")
def observation(planner) -> Observation:
    T_base_camera = camera_pose(planner._kinematics)
    return make_observation(T_base_camera, cylinder(*AT, T_base_camera[:3, 3]))


def score(planner: GraspPlanner, observation: Observation, poses: list[np.ndarray], scores=None) -> np.ndarray:
    """Return the scores of grasps at `poses` (base frame), of the generator's `scores`, or all equal."""
    grasps = in_camera(observation.T_base_camera, poses)
    if scores is not None:
        grasps = GraspSet(T_camera_grasps=grasps.T_camera_grasps, scores=np.array(scores), widths_m=grasps.widths_m)
    kinematics = planner._kinematics
    ranker = ReachabilityRanker(kinematics, make_checker(kinematics, observation), PlannerConfig())
    box: OrientedBox = fit_upright_box(observation)
    return ranker.scores(make_candidates(kinematics, grasps, observation, chunk=None), box, np.ones(len(poses)))


def test_reachable_grasps_go_before_grasps_out_of_reach_or_blocked(planner, observation):
    behind = frontal(*AT, 0.085, np.deg2rad(20), np.pi)
    under_the_table = frontal(*AT, 0.06, np.deg2rad(-60))
    reachable, out_of_reach, blocked = score(planner, observation, [GOOD, behind, under_the_table], [0.1, 1.0, 1.0])
    assert reachable > 2.0 > out_of_reach
    assert reachable > 2.0 > blocked
    assert max(out_of_reach, blocked) < 1.0


def test_near_the_centre_is_better_than_near_the_rim(planner, observation):
    rim = frontal(*AT, HEIGHT_M - 0.02, np.deg2rad(20))
    centred, high = score(planner, observation, [GOOD, rim])
    assert centred > high > 2.0


def test_between_equal_poses_the_generators_score_decides(planner, observation):
    low, high = score(planner, observation, [GOOD, GOOD], [0.2, 0.9])
    assert high - low == pytest.approx(0.999 * planner.config.reachability.generator * 0.7)


@pytest.mark.integration
def test_the_first_in_that_order_is_the_one_that_is_executed(planner, observation):
    rng = np.random.default_rng(0)
    grasps = [frontal(*AT, rng.uniform(0.04, 0.14), rng.uniform(-0.5, 1.4), rng.uniform(-2.5, 2.5)) for _ in range(60)]
    order = np.argsort(-score(planner, observation, grasps), kind="stable")
    ranked = in_camera(observation.T_base_camera, [grasps[n] for n in order])
    plan = planner.plan(make_candidates(planner._kinematics, ranked, observation), Q_START)
    as_drawn = planner.plan(
        make_candidates(planner._kinematics, in_camera(observation.T_base_camera, grasps), observation), Q_START
    )
    assert plan.rank == 0
    assert as_drawn.rank > 0


def test_weights_that_do_not_add_up_are_rejected():
    with raises(InvalidValueError, "invalid_value"):
        ReachabilityConfig(centring=0.9)
    with raises(InvalidValueError, "invalid_value"):
        ReachabilityConfig(n_reached=200)
