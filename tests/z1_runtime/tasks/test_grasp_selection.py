"""From a frame to a plan on the drawn can; each kind of bad input is one clear error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.transforms import transform_points
from models.obb.mvbb import fit_obb, rank_grasps
from models.obb.obb import DegenerateCloudError
from models.types import GraspSet
from tests.support.errors import raises
from tests.support.tabletop_scene import frame_of
from z1_runtime.config import RuntimeConfig
from z1_runtime.factory import draw_can, make_grasp_selector, warm_up_selector
from z1_runtime.perception import extrinsics
from z1_runtime.perception.detector import NoDepthError, NoDetectionError, PerceptionError
from z1_runtime.perception.detectors.ground_truth import GroundTruthDetector
from z1_runtime.planning.planner import NoPlanError
from z1_runtime.tasks.grasp_selection import GraspSelector, StageTimes

Q = np.append(z1.Q_HOME, -1.0)
CONFIG = RuntimeConfig(detector="tabletop", generator="antipodal", n_candidates=300)


@pytest.fixture(scope="module")
def selector() -> GraspSelector:
    return make_grasp_selector(CONFIG)


@pytest.fixture(scope="module")
def T_base_camera(selector) -> np.ndarray:
    return selector.kinematics.flange(z1.Q_HOME) @ z1.T_FLANGE_CAMERA


@pytest.fixture(scope="module")
def selection(selector, T_base_camera):
    return selector.select(draw_can(T_base_camera), Q)


class Corrupted:
    """A perception whose object cloud is corrupted."""

    def __init__(self, perception, corrupt):
        self._perception, self._corrupt = perception, corrupt

    def filter_self(self, *args):
        return self._perception.filter_self(*args)

    def detect(self, *args):
        return self._perception.detect(*args)

    def segment(self, *args):
        observation = self._perception.segment(*args)
        return replace(observation, object_points=self._corrupt(observation.object_points.copy()))


def with_part(selector: GraspSelector, **part) -> GraspSelector:
    parts = {name: getattr(selector, name) for name in ("kinematics", "perception", "generator", "planner", "config")}
    return GraspSelector(**(parts | part))


@pytest.mark.integration
def test_the_drawn_can_has_the_measures_of_its_parameters(selection, T_base_camera):
    points = transform_points(T_base_camera, selection.observation.object_points)
    assert np.abs(np.hypot(points[:, 0] - 0.48, points[:, 1]) - 0.03).mean() < 0.003
    assert points[:, 2].max() == pytest.approx(0.15, abs=0.002)


def test_a_can_is_grasped_in_place_by_a_plan_that_starts_at_the_arm(selection):
    plan = selection.plan
    assert np.hypot(*(plan.T_base_grasp[:2, 3] - [0.48, 0.0])) < 0.04
    assert plan.width_m == pytest.approx(0.06, abs=0.01)
    assert plan.transfer.q[0] == pytest.approx(Q)


def test_every_stage_is_timed_and_the_total_holds_them_all(selection):
    assert set(selection.stage_ms) == {
        "detect",
        "cloud",
        "generate",
        "mvbb",
        "rank",
        "ik",
        "collision",
        "plan",
        "total",
    }
    parts = sum(ms for name, ms in selection.stage_ms.items() if name != "total")
    assert 0.0 < parts <= selection.stage_ms["total"]


@pytest.mark.integration
def test_the_box_filters_the_candidates_by_the_configuration(selector, selection, T_base_camera):
    assert len(selection.grasps) == CONFIG.n_candidates
    box = fit_obb(selection.observation.object_points, CONFIG.box_method, up=T_base_camera[2, :3])
    filtered = rank_grasps(selection.grasps, box, k=CONFIG.k_faces, alpha=CONFIG.alpha)
    assert sorted(selection.ranked.indices) == sorted(filtered.indices)
    assert (np.diff(selection.ranked.scores) <= 0.0).all()
    assert selection.plan.rank == 0
    assert 0 < len(selection.ranked) < len(selection.grasps)
    one_face = with_part(selector, config=replace(CONFIG, k_faces=1)).select(draw_can(T_base_camera), Q)
    assert len(one_face.ranked) < len(selection.ranked)


@pytest.mark.integration
def test_the_same_frame_and_seed_give_the_same_plan_bit_by_bit(selector, selection, T_base_camera):
    again = selector.select(draw_can(T_base_camera), Q)
    assert again.ranked.indices.tolist() == selection.ranked.indices.tolist()
    assert again.plan.rejections == selection.plan.rejections
    for phase in ("transfer", "approach", "close", "lift"):
        assert getattr(again.plan, phase).q.tobytes() == getattr(selection.plan, phase).q.tobytes()
    other = with_part(selector, config=replace(CONFIG, seed=7)).select(draw_can(T_base_camera), Q)
    assert other.grasps.T_camera_grasps.tobytes() != selection.grasps.T_camera_grasps.tobytes()


def test_an_all_zero_depth_image_raises_no_depth(selector):
    with pytest.raises(NoDepthError):
        selector.select(frame_of(np.zeros((480, 640), np.float32)), Q)


def test_an_empty_table_raises_no_detection(selector, T_base_camera):
    with pytest.raises(NoDetectionError):
        selector.select(draw_can(T_base_camera, height_m=1e-4), Q)


def test_a_detector_that_needs_the_twin_fails_without_it(selector, T_base_camera):
    ground_truth_only = make_grasp_selector(replace(CONFIG, detector="ground_truth"))
    assert isinstance(ground_truth_only.perception._detector, GroundTruthDetector)
    with pytest.raises(PerceptionError):
        ground_truth_only.select(replace(draw_can(T_base_camera), ground_truth_mask=None), Q)


def nan_in_the_middle(points: np.ndarray) -> np.ndarray:
    points[len(points) // 2, 1] = np.nan
    return points


@pytest.mark.parametrize(
    "corrupt",
    [
        lambda points: points[:0],
        lambda points: points[:10],
        nan_in_the_middle,
        lambda points: points[:1].repeat(200, axis=0),
    ],
    ids=["empty", "few", "nan", "one place"],
)
def test_a_cloud_that_cannot_be_grasped_is_an_error(selector, T_base_camera, corrupt):
    with pytest.raises((InvalidValueError, DegenerateCloudError)):
        with_part(selector, perception=Corrupted(selector.perception, corrupt)).select(draw_can(T_base_camera), Q)


def test_a_cloud_that_spans_no_box_is_an_error_with_any_generator(selector, selection, T_base_camera):
    class Anything:
        def sample(self, points, n, seed):
            return selection.grasps

    corrupted = Corrupted(selector.perception, nan_in_the_middle)
    with pytest.raises(DegenerateCloudError):
        with_part(selector, perception=corrupted, generator=Anything()).select(draw_can(T_base_camera), Q)


def test_candidates_that_all_come_from_behind_leave_no_plan(selector, selection, T_base_camera):
    class FromBehind:
        def sample(self, points, n, seed):
            T = selection.grasps.T_camera_grasps.copy()
            T[:, :3, :3] = np.column_stack([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
            return GraspSet(T_camera_grasps=T, scores=np.ones(len(T)), widths_m=np.full(len(T), 0.06))

    with raises(NoPlanError, "no_face") as caught:
        with_part(selector, generator=FromBehind()).select(draw_can(T_base_camera), Q)
    assert "none of 300 candidates approaches one of the 2 nearest faces" in str(caught.value)


@pytest.mark.integration
@pytest.mark.parametrize("detector", ["yolo", "tabletop", "ground_truth"])
def test_warming_up_needs_no_camera_with_any_detector(detector, caplog):
    with caplog.at_level("INFO", "z1_runtime.factory"):
        warm_up_selector(make_grasp_selector(replace(RuntimeConfig(), detector=detector)))
    assert not caplog.records


@pytest.mark.integration
def test_warming_up_reads_the_jaws_meshes_though_no_jaws_are_drawn(selector):
    extrinsics._sample_mesh.cache_clear()
    warm_up_selector(selector)
    assert extrinsics._sample_mesh.cache_info().currsize == 2


@pytest.mark.integration
def test_a_warm_up_scene_without_a_plan_is_logged_and_a_real_one_is_an_error(T_base_camera, caplog):
    config = RuntimeConfig(detector="tabletop", generator="antipodal")
    high = make_grasp_selector(replace(config, planner=replace(config.planner, lift_m=0.5)))
    with caplog.at_level("INFO", "z1_runtime.factory"):
        warm_up_selector(high)
    assert "no plan" in caplog.text
    with raises(NoPlanError, "no_plan"):
        high.select(draw_can(T_base_camera), np.append(z1.Q_HOME, -1.0))


@pytest.mark.integration
def test_every_stage_can_be_called_alone_and_none_is_entered_twice(selector, selection, T_base_camera, monkeypatch):
    calls = []
    for name in ("observe", "generate", "filter", "build_scene", "rank"):
        stage = getattr(selector, name)
        monkeypatch.setattr(selector, name, lambda *args, stage=stage, name=name: calls.append(name) or stage(*args))
    selector.select(draw_can(T_base_camera), Q)
    assert calls == ["observe", "generate", "filter", "build_scene", "rank"]

    observation = selector.observe(draw_can(T_base_camera), Q)
    filtered = selector.filter(selector.generate(observation), observation)
    scene = selector.build_scene(observation, Q)
    best_first = selector.rank(filtered, scene)
    assert best_first.candidates.scene is scene
    assert best_first.candidates.upright_box is filtered.box is best_first.ranked.box
    np.testing.assert_array_equal(
        best_first.candidates.grasps.T_camera_grasps, best_first.ranked.grasps.T_camera_grasps
    )
    plan = selector.planner.plan(best_first.candidates, Q)
    assert plan.rank == selection.plan.rank
    assert plan.approach.q.tobytes() == selection.plan.approach.q.tobytes()


def test_stage_times_add_up_by_name_and_keep_what_an_error_cost():
    times = StageTimes()
    for _ in range(2):
        with times.stage("a"):
            pass
    with pytest.raises(RuntimeError), times.stage("b"):
        raise RuntimeError
    assert list(times.ms) == ["a", "b"]
    assert all(ms > 0.0 for ms in times.ms.values())
