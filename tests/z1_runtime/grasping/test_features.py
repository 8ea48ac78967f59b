"""What is measured of a grasp is what a ruler would say; and a fitted head orders the runtime's grasps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from hal.base.transforms import inverse
from tests.support.tabletop_scenes import (
    HEIGHT_M,
    RADIUS_M,
    camera_pose,
    cylinder,
    frontal,
    in_camera,
    make_observation,
)
from z1_runtime.config import RuntimeConfig
from z1_runtime.factory import make_grasp_selector
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.features import FEATURES
from z1_runtime.grasping.ranking import Ranking, Scoring, ScoringError, ScoringHead, save_scoring
from z1_runtime.planning.planner import GraspPlanner
from z1_runtime.tasks.grasp_selection import GraspSelector, draw_can
from z1_runtime.types import Observation

AT = (0.46, 0.08)
PITCH_RAD = np.deg2rad(20)
LOW, HIGH = frontal(*AT, 0.075, PITCH_RAD), frontal(*AT, HEIGHT_M - 0.02, PITCH_RAD)
HIGHER_IS_BETTER = ScoringHead(features=("above_m",), mean=(0.0,), scale=(0.03,), coefficients=(1.0,), intercept=0.0)


@pytest.fixture(scope="module")
def planner() -> GraspPlanner:
    return GraspPlanner(Kinematics())


@pytest.fixture(scope="module")
def observation(planner) -> Observation:
    T_base_camera = camera_pose(planner._kinematics)
    return make_observation(T_base_camera, cylinder(*AT, T_base_camera[:3, 3]))


def test_a_grasp_is_measured_as_by_a_ruler(planner, observation):
    grasps = in_camera(observation.T_base_camera, [LOW, HIGH])
    low, high = (dict(zip(FEATURES, row, strict=True)) for row in planner.features(grasps, observation))
    assert low["generator"] == 1.0
    assert low["down"] == pytest.approx(np.sin(PITCH_RAD), abs=1e-3)
    assert low["outward"] == pytest.approx(np.cos(PITCH_RAD), abs=1e-3)
    assert low["reach_m"] == pytest.approx(np.hypot(*AT), abs=1e-6)
    assert low["height_m"] == pytest.approx(0.075, abs=1e-3)
    assert low["width_m"] == pytest.approx(2 * RADIUS_M, abs=0.012)
    assert low["above_m"] == pytest.approx(0.0, abs=0.006)
    assert low["away_m"] < 0.02
    assert high["above_m"] - low["above_m"] == pytest.approx(HEIGHT_M - 0.095, abs=1e-6)
    assert low["support"] > 0.9
    assert low["alignment"] > 0.8


def test_what_is_measured_does_not_depend_on_the_grasps_beside_it(planner, observation):
    both = planner.features(in_camera(observation.T_base_camera, [LOW, HIGH]), observation)
    alone = planner.features(in_camera(observation.T_base_camera, [HIGH]), observation)
    assert alone[0] == pytest.approx(both[1], abs=1e-12)


def worth(planner, observation, ranking: Ranking | None, alignments=(1.0, 1.0)) -> np.ndarray:
    middle = inverse(observation.T_base_camera) @ [*AT, HEIGHT_M / 2, 1.0]
    grasps = in_camera(observation.T_base_camera, [LOW, HIGH])
    return planner.ability(grasps, observation, middle[:3], np.array(alignments), ranking)


def test_a_head_stands_for_the_weights_among_what_the_arm_can_reach(planner, observation):
    low, high = worth(planner, observation, None)
    assert low > high > 2.0
    low, high = worth(planner, observation, Ranking(head=HIGHER_IS_BETTER))
    assert high > low > 2.0


def test_a_ranking_without_head_and_thresholds_changes_nothing(planner, observation):
    assert worth(planner, observation, Ranking()).tolist() == worth(planner, observation, None).tolist()


def test_what_is_below_a_threshold_comes_last_but_is_not_lost(planner, observation):
    low, high = worth(planner, observation, Ranking(min_alignment=0.5), alignments=(0.4, 0.9))
    assert high > low > 2.0


def test_a_decider_reads_the_file_that_its_configuration_names(tmp_path):
    def decider(config: RuntimeConfig) -> GraspSelector:
        return make_grasp_selector(replace(config, n_candidates=200))

    q = np.append(z1.Q_HOME, -1.0)
    plain = decider(RuntimeConfig(detector="tabletop"))
    frame = draw_can(plain.kinematics.flange(z1.Q_HOME) @ z1.T_FLANGE_CAMERA)
    by_hand = plain.decide(frame, q).ranked

    path = tmp_path / "scoring.yaml"
    save_scoring(Scoring(mvb=Ranking(), full=plain.ranking), path)
    same = decider(RuntimeConfig(detector="tabletop", scoring=str(path))).decide(frame, q).ranked
    assert same.indices.tolist() == by_hand.indices.tolist()

    save_scoring(Scoring(mvb=Ranking(), full=replace(plain.ranking, k_faces=1, head=HIGHER_IS_BETTER)), path)
    fitted = decider(RuntimeConfig(detector="tabletop", scoring=str(path))).decide(frame, q).ranked
    assert 0 < len(fitted) < len(by_hand)
    assert fitted.indices[0] != by_hand.indices[0]

    path.write_text("format: other")
    with pytest.raises(ScoringError, match="no scoring file"):
        decider(RuntimeConfig(detector="tabletop", scoring=str(path)))
