"""Features of grasps of known geometry, and a fitted head that orders the runtime's grasps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from tests.support.errors import raises
from tests.support.tabletop_scenes import (
    HEIGHT_M,
    RADIUS_M,
    camera_pose,
    cylinder,
    frontal,
    in_camera,
    make_candidates,
    make_checker,
    make_observation,
)
from z1_runtime.config import RuntimeConfig
from z1_runtime.factory import draw_can, make_grasp_selector
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.ranking import (
    FEATURES,
    Ranking,
    Scoring,
    ScoringError,
    ScoringHead,
    fit_upright_box,
    measure_features,
    save_scoring,
)
from z1_runtime.planning.config import PlannerConfig
from z1_runtime.planning.reachability import ReachabilityRanker
from z1_runtime.tasks.grasp_selection import GraspSelector
from z1_runtime.types import Observation

AT = (0.46, 0.08)
PITCH_RAD = np.deg2rad(20)
LOW, HIGH = frontal(*AT, 0.075, PITCH_RAD), frontal(*AT, HEIGHT_M - 0.02, PITCH_RAD)
HIGHER_IS_BETTER = ScoringHead(features=("above_m",), mean=(0.0,), scale=(0.03,), coefficients=(1.0,), intercept=0.0)


@pytest.fixture(scope="module")
def kinematics() -> Kinematics:
    return Kinematics()


@pytest.fixture(scope="module")
def observation(kinematics) -> Observation:
    T_base_camera = camera_pose(kinematics)
    return make_observation(T_base_camera, cylinder(*AT, T_base_camera[:3, 3]))


def features(kinematics: Kinematics, observation: Observation, poses: list[np.ndarray]) -> np.ndarray:
    return measure_features(make_candidates(kinematics, in_camera(observation.T_base_camera, poses), observation))


def test_the_features_are_the_distances_of_the_scene(kinematics, observation):
    low, high = (dict(zip(FEATURES, row, strict=True)) for row in features(kinematics, observation, [LOW, HIGH]))
    assert low["generator"] == 1.0
    assert low["down"] == pytest.approx(np.sin(PITCH_RAD), abs=1e-3)
    assert low["outward"] == pytest.approx(np.cos(PITCH_RAD), abs=1e-3)
    assert low["reach_m"] == pytest.approx(np.hypot(*AT), abs=1e-6)
    assert low["height_m"] == pytest.approx(0.075, abs=1e-3)
    assert low["width_m"] == pytest.approx(2 * RADIUS_M, abs=0.012)
    assert low["above_m"] == pytest.approx(0.0, abs=0.006)
    assert low["distance_to_centre_m"] < 0.02
    assert high["above_m"] - low["above_m"] == pytest.approx(HEIGHT_M - 0.095, abs=1e-6)
    assert low["support"] > 0.9
    assert low["alignment"] > 0.8


def test_features_do_not_depend_on_the_other_grasps(kinematics, observation):
    both = features(kinematics, observation, [LOW, HIGH])
    alone = features(kinematics, observation, [HIGH])
    assert alone[0] == pytest.approx(both[1], abs=1e-12)


def score(kinematics, observation, ranking: Ranking | None, alignments=(1.0, 1.0)) -> np.ndarray:
    grasps = in_camera(observation.T_base_camera, [LOW, HIGH])
    candidates = make_candidates(kinematics, grasps, observation, chunk=None)
    ranker = ReachabilityRanker(kinematics, make_checker(kinematics, observation), PlannerConfig())
    head = ranking.head if ranking else None
    probability = head.probability(measure_features(candidates)) if head else None
    return ranker.scores(candidates, fit_upright_box(observation), np.array(alignments), ranking, probability)


def test_a_head_replaces_the_weights_among_reachable_grasps(kinematics, observation):
    low, high = score(kinematics, observation, None)
    assert low > high > 2.0
    low, high = score(kinematics, observation, Ranking(head=HIGHER_IS_BETTER))
    assert high > low > 2.0


def test_a_ranking_without_head_and_thresholds_changes_nothing(kinematics, observation):
    assert score(kinematics, observation, Ranking()).tolist() == score(kinematics, observation, None).tolist()


def test_a_grasp_below_a_threshold_comes_last_but_is_kept(kinematics, observation):
    low, high = score(kinematics, observation, Ranking(min_alignment=0.5), alignments=(0.4, 0.9))
    assert high > low > 2.0


@pytest.mark.integration
def test_a_selector_reads_the_file_that_its_configuration_names(tmp_path):
    def selector(config: RuntimeConfig) -> GraspSelector:
        return make_grasp_selector(replace(config, n_candidates=200))

    q = np.append(z1.Q_HOME, -1.0)
    plain = selector(RuntimeConfig(detector="tabletop"))
    frame = draw_can(plain.kinematics.flange(z1.Q_HOME) @ z1.T_FLANGE_CAMERA)
    configured = plain.select(frame, q).ranked

    path = tmp_path / "scoring.yaml"
    save_scoring(Scoring(mvb=Ranking(), full=plain.ranking), path)
    same = selector(RuntimeConfig(detector="tabletop", scoring=path)).select(frame, q).ranked
    assert same.indices.tolist() == configured.indices.tolist()

    save_scoring(Scoring(mvb=Ranking(), full=replace(plain.ranking, k_faces=1, head=HIGHER_IS_BETTER)), path)
    fitted = selector(RuntimeConfig(detector="tabletop", scoring=path)).select(frame, q).ranked
    assert 0 < len(fitted) < len(configured)
    assert fitted.indices[0] != configured.indices[0]

    path.write_text("format: other")
    with raises(ScoringError, "scoring_format"):
        selector(RuntimeConfig(detector="tabletop", scoring=path))
