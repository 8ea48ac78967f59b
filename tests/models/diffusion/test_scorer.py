"""The discriminator of the shipped weights as a scorer of any generator's grasps."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from hal.base.errors import InvalidValueError
from hal.base.transforms import inverse
from models.diffusion.sampler import DiffusionConfig, DiffusionSampler
from models.diffusion.scorer import GraspScorer, measure_widths
from models.diffusion.training.grippers import GRIPPERS
from models.diffusion.training.labels import check_grasps
from models.diffusion.training.shapes import make_shape
from models.diffusion.training.views import ViewConfig, render_view
from models.types import GraspSet
from models.weights_file import WeightsError
from tests.support.errors import raises


@pytest.fixture(scope="module")
def scorer() -> GraspScorer:
    return GraspScorer()


@pytest.fixture(scope="module")
def box_view():
    rng = np.random.default_rng(7)
    solid = make_shape("box", rng)
    view = render_view(solid, ViewConfig(occluded_view_ratio=0.0, flying_point_ratio=0.0), rng)
    assert view is not None
    return solid, *view


def as_set(T: np.ndarray, width_m: float = np.nan) -> GraspSet:
    return GraspSet(T_camera_grasps=T, scores=np.zeros(len(T)), widths_m=np.full(len(T), width_m))


@pytest.mark.integration
def test_scores_of_the_samplers_grasps_correlate_with_its_own(scorer, box_view):
    points = box_view[1]
    # None are dropped, so valid and invalid ones; the sampler scores them before their axes are orthonormalised.
    grasps = DiffusionSampler().draw(points, 100, 5)
    scores = scorer.score(points, grasps, 5)
    assert np.corrcoef(scores, grasps.scores)[0, 1] > 0.8


@pytest.mark.integration
def test_valid_grasps_score_above_the_same_turned_by_90_degrees(scorer, box_view):
    solid, points, T_camera_object = box_view
    grasps = DiffusionSampler().sample(points, 200, 1)
    check = check_grasps(solid, inverse(T_camera_object) @ grasps.T_camera_grasps, GRIPPERS["agnostic"])
    good = grasps.T_camera_grasps[check.valid][:50]
    turned = good.copy()
    turned[:, :3, :2] = good[:, :3, 1::-1] * [1.0, -1.0]  # about the approach: the jaws close on edges or on air
    fails = ~check_grasps(solid, inverse(T_camera_object) @ turned, GRIPPERS["agnostic"]).valid
    held, missed = scorer.score(points, as_set(good)), scorer.score(points, as_set(turned[fails]))
    assert fails.sum() > 20 and held.mean() > missed.mean() + 0.2


@pytest.mark.integration
def test_concurrent_calls_give_the_same_scores_as_single_ones(scorer, box_view):
    points = box_view[1]
    grasps = DiffusionSampler().sample(points, 40, 2)
    alone = scorer.score(points, grasps, 3)
    with ThreadPoolExecutor(4) as pool:
        for scores in pool.map(lambda _: scorer.score(points, grasps, 3), range(8)):
            np.testing.assert_array_equal(scores, alone)


def test_a_missing_width_is_measured_between_the_pads():
    wall = np.array([[0.0, y, -0.01] for y in np.linspace(-0.02, 0.005, 40)])
    nowhere = np.eye(4)
    nowhere[:3, 3] = 5.0
    assert measure_widths(wall, np.stack([np.eye(4), nowhere])) == pytest.approx([0.04, 0.055])


def test_bad_input_and_missing_weights_are_rejected(scorer, box_view, tmp_path):
    points = box_view[1]
    with raises(InvalidValueError, "grasp_count"):
        scorer.score(points, as_set(np.zeros((0, 4, 4))))
    with raises(InvalidValueError, "cloud_extent"):
        scorer.score(1000.0 * points, as_set(np.eye(4)[None]))
    with raises(WeightsError, "weights_missing"):
        GraspScorer(DiffusionConfig(weights=tmp_path / "none.npz"))
