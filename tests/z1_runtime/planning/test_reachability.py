"""What the arm can do goes first, whatever a generator thinks of it."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base.transforms import inverse
from models.types import GraspSet
from tests.support.tabletop_scenes import HEIGHT_M, Q_START, camera_pose, cylinder, frontal, in_camera, make_observation
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.planning.planner import GraspPlanner
from z1_runtime.planning.reachability_config import ReachabilityConfig
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


def worth(planner: GraspPlanner, observation: Observation, grasps: list[np.ndarray], scores=None) -> np.ndarray:
    """Return what `grasps` (base frame) are worth, all alike to the generator unless `scores` says otherwise."""
    candidates = in_camera(observation.T_base_camera, grasps)
    if scores is not None:
        candidates = GraspSet(
            T_camera_grasps=candidates.T_camera_grasps, scores=np.array(scores), widths_m=candidates.widths_m
        )
    middle = inverse(observation.T_base_camera) @ [*AT, HEIGHT_M / 2, 1.0]
    return planner.ability(candidates, observation, middle[:3], np.ones(len(grasps)))


def test_what_can_be_done_goes_before_what_is_out_of_reach_and_that_before_what_has_no_room(planner, observation):
    behind = frontal(*AT, 0.085, np.deg2rad(20), np.pi)
    under_the_table = frontal(*AT, 0.06, np.deg2rad(-60))
    can, cannot, no_room = worth(planner, observation, [GOOD, behind, under_the_table], [0.1, 1.0, 1.0])
    assert can > 2.0 > cannot
    assert can > 2.0 > no_room
    assert max(cannot, no_room) < 1.0


def test_near_the_middle_is_better_than_near_the_rim(planner, observation):
    rim = frontal(*AT, HEIGHT_M - 0.02, np.deg2rad(20))
    middle, high = worth(planner, observation, [GOOD, rim])
    assert middle > high > 2.0


def test_of_grasps_that_are_else_the_same_the_generators_word_counts(planner, observation):
    low, high = worth(planner, observation, [GOOD, GOOD], [0.2, 0.9])
    assert high - low == pytest.approx(0.999 * planner.config.ability.generator * 0.7)


def test_the_first_in_that_order_is_the_one_that_is_executed(planner, observation):
    rng = np.random.default_rng(0)
    grasps = [frontal(*AT, rng.uniform(0.04, 0.14), rng.uniform(-0.5, 1.4), rng.uniform(-2.5, 2.5)) for _ in range(60)]
    order = np.argsort(-worth(planner, observation, grasps), kind="stable")
    ranked = in_camera(observation.T_base_camera, [grasps[n] for n in order])
    plan = planner.plan(ranked, observation, Q_START)
    as_drawn = planner.plan(in_camera(observation.T_base_camera, grasps), observation, Q_START)
    assert plan.rank == 0
    assert as_drawn.rank > 0


def test_weights_that_do_not_add_up_are_refused():
    with pytest.raises(ValueError, match="their sum must be 1"):
        ReachabilityConfig(centring=0.9)
    with pytest.raises(ValueError, match="n_reached <= n_asked"):
        ReachabilityConfig(n_reached=200)
