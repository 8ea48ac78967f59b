"""From a frame to a plan on the drawn can; and each kind of bad input, which is one clear error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from hal.base.transforms import transform_points
from models.obb.mvbb import fit_obb, rank_grasps
from models.obb.obb import DegenerateCloudError
from models.types import GraspSet
from tests.support.tabletop_scene import frame_of
from z1_runtime.config import RuntimeConfig
from z1_runtime.factory import make_grasp_selector
from z1_runtime.perception import extrinsics_check
from z1_runtime.perception.detectors.ground_truth import GroundTruthDetector
from z1_runtime.perception.errors import NoDepthError, NoDetectionError, PerceptionError
from z1_runtime.planning.planner import NoPlanError
from z1_runtime.tasks.grasp_selection import GraspSelector, StageTimes, draw_can

Q = np.append(z1.Q_HOME, -1.0)
CONFIG = RuntimeConfig(detector="tabletop", generator="antipodal", n_candidates=300)


@pytest.fixture(scope="module")
def decider() -> GraspSelector:
    return make_grasp_selector(CONFIG)


@pytest.fixture(scope="module")
def T_base_camera(decider) -> np.ndarray:
    return decider.kinematics.flange(z1.Q_HOME) @ z1.T_FLANGE_CAMERA


@pytest.fixture(scope="module")
def decision(decider, T_base_camera):
    return decider.decide(draw_can(T_base_camera), Q)


class Spoiled:
    """A perception that sees well, and then spoils the object's cloud."""

    def __init__(self, perception, spoil):
        self._perception, self._spoil = perception, spoil

    def detect(self, *args):
        return self._perception.detect(*args)

    def segment(self, *args):
        observation = self._perception.segment(*args)
        return replace(observation, object_points=self._spoil(observation.object_points.copy()))


def with_part(decider: GraspSelector, **part) -> GraspSelector:
    parts = {name: getattr(decider, name) for name in ("kinematics", "perception", "generator", "planner", "config")}
    return GraspSelector(**(parts | part))


def test_the_drawn_can_is_the_can_it_says_it_is(decision, T_base_camera):
    points = transform_points(T_base_camera, decision.observation.object_points)
    assert np.abs(np.hypot(points[:, 0] - 0.48, points[:, 1]) - 0.03).mean() < 0.003
    assert points[:, 2].max() == pytest.approx(0.15, abs=0.002)


def test_a_can_is_grasped_where_it_stands_by_a_plan_that_starts_at_the_arm(decision):
    plan = decision.plan
    assert np.hypot(*(plan.T_base_grasp[:2, 3] - [0.48, 0.0])) < 0.04
    assert plan.width_m == pytest.approx(0.06, abs=0.01)
    assert plan.transfer.q[0] == pytest.approx(Q)


def test_every_stage_is_timed_and_the_total_holds_them_all(decision):
    assert set(decision.stage_ms) == {"detect", "cloud", "generate", "mvbb", "rank", "ik", "collision", "plan", "total"}
    parts = sum(ms for name, ms in decision.stage_ms.items() if name != "total")
    assert 0.0 < parts <= decision.stage_ms["total"]


def test_the_box_chooses_among_the_candidates_as_the_configuration_says(decider, decision, T_base_camera):
    assert len(decision.candidates) == CONFIG.n_candidates
    box = fit_obb(decision.observation.object_points, CONFIG.box_method, up=T_base_camera[2, :3])
    by_hand = rank_grasps(decision.candidates, box, k=CONFIG.k_faces, alpha=CONFIG.alpha)
    assert sorted(decision.ranked.indices) == sorted(by_hand.indices)
    assert (np.diff(decision.ranked.scores) <= 0.0).all()
    assert decision.plan.rank == 0
    assert 0 < len(decision.ranked) < len(decision.candidates)
    one_face = with_part(decider, config=replace(CONFIG, k_faces=1)).decide(draw_can(T_base_camera), Q)
    assert len(one_face.ranked) < len(decision.ranked)


def test_the_same_frame_and_seed_give_the_same_plan_bit_by_bit(decider, decision, T_base_camera):
    again = decider.decide(draw_can(T_base_camera), Q)
    assert again.ranked.indices.tolist() == decision.ranked.indices.tolist()
    assert again.plan.rejections == decision.plan.rejections
    for leg in ("transfer", "approach", "close", "lift"):
        assert getattr(again.plan, leg).q.tobytes() == getattr(decision.plan, leg).q.tobytes()
    other = with_part(decider, config=replace(CONFIG, seed=7)).decide(draw_can(T_base_camera), Q)
    assert other.candidates.T_camera_grasps.tobytes() != decision.candidates.T_camera_grasps.tobytes()


def test_an_all_zero_depth_image_is_told(decider):
    with pytest.raises(NoDepthError, match="all zero"):
        decider.decide(frame_of(np.zeros((480, 640), np.float32)), Q)


def test_an_empty_table_is_told(decider, T_base_camera):
    with pytest.raises(NoDetectionError, match="found no object"):
        decider.decide(draw_can(T_base_camera, height_m=1e-4), Q)


def test_a_detector_that_needs_the_twin_is_told_apart(decider, T_base_camera):
    blind = make_grasp_selector(replace(CONFIG, detector="truth"))
    assert isinstance(blind.perception._detector, GroundTruthDetector)
    with pytest.raises(PerceptionError, match="--detector tabletop"):
        blind.decide(replace(draw_can(T_base_camera), ground_truth_mask=None), Q)


def nan_in_the_middle(points: np.ndarray) -> np.ndarray:
    points[len(points) // 2, 1] = np.nan
    return points


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda points: points[:0], "30 points or more"),
        (lambda points: points[:10], "30 points or more"),
        (nan_in_the_middle, "NaN or infinite"),
        (lambda points: points[:1].repeat(200, axis=0), "one line|opposite sides"),
    ],
    ids=["empty", "few", "nan", "one place"],
)
def test_a_cloud_that_cannot_be_grasped_is_told(decider, T_base_camera, spoil, said):
    with pytest.raises(ValueError, match=said):
        with_part(decider, perception=Spoiled(decider.perception, spoil)).decide(draw_can(T_base_camera), Q)


def test_a_cloud_that_spans_no_box_is_told_whatever_the_generator_made_of_it(decider, decision, T_base_camera):
    class Anything:
        def sample(self, points, n, seed):
            return decision.candidates

    spoiled = Spoiled(decider.perception, nan_in_the_middle)
    with pytest.raises(DegenerateCloudError, match=r"1 of \d+ points are NaN"):
        with_part(decider, perception=spoiled, generator=Anything()).decide(draw_can(T_base_camera), Q)


def test_candidates_that_all_come_from_behind_leave_no_plan(decider, decision, T_base_camera):
    class FromBehind:
        def sample(self, points, n, seed):
            T = decision.candidates.T_camera_grasps.copy()
            T[:, :3, :3] = np.column_stack([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
            return GraspSet(T_camera_grasps=T, scores=np.ones(len(T)), widths_m=np.full(len(T), 0.06))

    with pytest.raises(NoPlanError, match="none of 300 candidates comes at one of the 2 nearest faces"):
        with_part(decider, generator=FromBehind()).decide(draw_can(T_base_camera), Q)


@pytest.mark.parametrize("detector", ["yolo", "tabletop", "truth"])
def test_warming_up_decides_without_a_camera_whichever_the_detector(detector, caplog):
    with caplog.at_level("INFO", "z1_runtime.tasks.grasp_selection"):
        make_grasp_selector(replace(RuntimeConfig(), detector=detector)).warm_up()
    assert not caplog.records


def test_warming_up_reads_the_jaws_meshes_though_no_jaws_are_drawn(decider):
    extrinsics_check._sampled.cache_clear()
    decider.warm_up()
    assert extrinsics_check._sampled.cache_info().currsize == 2


def test_a_configuration_that_cannot_grasp_the_warm_up_scene_is_told_at_the_real_one(T_base_camera, caplog):
    config = RuntimeConfig(detector="tabletop", generator="antipodal")
    high = make_grasp_selector(replace(config, planner=replace(config.planner, lift_m=0.5)))
    with caplog.at_level("INFO", "z1_runtime.tasks.grasp_selection"):
        high.warm_up()
    assert "no plan" in caplog.text
    with pytest.raises(NoPlanError):
        high.decide(draw_can(T_base_camera), np.append(z1.Q_HOME, -1.0))


def test_stage_times_add_up_by_name_and_keep_what_an_error_cost():
    times = StageTimes()
    for _ in range(2):
        with times.stage("a"):
            pass
    with pytest.raises(RuntimeError), times.stage("b"):
        raise RuntimeError
    assert list(times.ms) == ["a", "b"]
    assert all(ms > 0.0 for ms in times.ms.values())
