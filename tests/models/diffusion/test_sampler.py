"""The diffusion sampler with the weights that ship."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import ndtr
from scipy.stats.qmc import discrepancy

from hal.base.errors import InvalidValueError
from hal.base.transforms import inverse
from models.diffusion.network import WeightsError
from models.diffusion.sampler import DiffusionConfig, DiffusionSampler, choose_grasps, draw_even_normal
from models.diffusion.training.grippers import GRIPPERS
from models.diffusion.training.labels import check_grasps
from models.diffusion.training.shapes import make_shape
from models.diffusion.training.views import ViewConfig, render_view
from tests.support.errors import raises

VIEW = ViewConfig(occluded_view_ratio=0.0, flying_point_ratio=0.0)


@pytest.fixture(scope="module")
def sampler() -> DiffusionSampler:
    return DiffusionSampler()


def make_bottle_view(seed: int):
    rng = np.random.default_rng(seed)
    solid = make_shape("bottle", rng)
    view = render_view(solid, VIEW, rng)
    assert view is not None
    return solid, *view


@pytest.mark.integration
def test_grasps_are_rigid_scored_and_best_first(sampler):
    grasps = sampler.sample(make_bottle_view(0)[1], 100, 0)
    R = grasps.T_camera_grasps[:, :3, :3]
    assert len(grasps) == 100
    assert R @ R.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (100, 1, 1)), abs=1e-6)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert (np.diff(grasps.scores) <= 0.0).all()
    assert grasps.scores.min() >= 0.0 and grasps.scores.max() <= 1.0
    assert grasps.widths_m.min() > 0.0


@pytest.mark.integration
def test_the_same_seed_gives_the_same_grasps_and_another_seed_others(sampler):
    points = make_bottle_view(0)[1]
    first, again, other = (sampler.sample(points, 50, seed) for seed in (3, 3, 4))
    assert np.array_equal(first.T_camera_grasps, again.T_camera_grasps)
    assert np.array_equal(first.scores, again.scores)
    assert not np.allclose(first.T_camera_grasps, other.T_camera_grasps)


@pytest.mark.integration
def test_turning_the_camera_turns_the_grasps_and_nothing_else(sampler):
    points = make_bottle_view(1)[1]
    R = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    grasps, turned = sampler.sample(points, 60, 0), sampler.sample(points @ R.T, 60, 0)
    assert turned.scores == pytest.approx(grasps.scores, abs=1e-3)
    assert turned.T_camera_grasps[:10, :3, :3] == pytest.approx(R @ grasps.T_camera_grasps[:10, :3, :3], abs=2e-3)


@pytest.mark.integration
def test_most_grasps_of_new_bottles_are_valid_and_the_best_scored_more_than_the_worst(sampler):
    raw, best, worst, width_errors = [], [], [], []
    for seed in range(50, 54):
        solid, points, T_camera_object = make_bottle_view(seed)
        grasps = sampler.sample(points, 200, 0)
        check = check_grasps(solid, inverse(T_camera_object) @ grasps.T_camera_grasps, GRIPPERS["agnostic"])
        raw.append(check.valid.mean())
        best.append(check.valid[:50].mean())
        worst.append(check.valid[-50:].mean())
        width_errors.append(np.median(np.abs(grasps.widths_m - check.widths_m)[check.valid]))
    assert np.mean(raw) > 0.7
    assert np.mean(best) > np.mean(worst) + 0.1
    assert np.median(width_errors) < 0.012


@pytest.mark.integration
def test_oversampling_gives_better_grasps_of_as_many_kinds(sampler):
    drawn_valid, chosen_valid, drawn_kinds, chosen_kinds = [], [], [], []
    for seed in range(70, 74):
        solid, points, T_camera_object = make_bottle_view(seed)
        T_object_camera = inverse(T_camera_object)
        for grasps, valid, kinds in (
            (sampler.draw(points, 200, 0), drawn_valid, drawn_kinds),
            (sampler.sample(points, 200, 0), chosen_valid, chosen_kinds),
        ):
            good = check_grasps(solid, T_object_camera @ grasps.T_camera_grasps, GRIPPERS["agnostic"]).valid
            valid.append(good.mean())
            kinds.append(len(np.unique(np.round(2.0 * grasps.T_camera_grasps[good, :3, 2]), axis=0)))
    assert np.mean(chosen_valid) > np.mean(drawn_valid) + 0.03
    assert np.mean(chosen_kinds) > 0.97 * np.mean(drawn_kinds)


@pytest.mark.integration
def test_bfloat16_moves_grasps_by_a_fraction_of_a_millimetre(sampler, monkeypatch):
    _, points, _ = make_bottle_view(70)
    places = []
    for quick in (False, True):
        monkeypatch.setattr(sampler, "_use_bfloat16", quick)
        places.append(sampler.draw(points, 200, 0).T_camera_grasps[:, :3, 3])
    distance = np.linalg.norm(places[0] - places[1], axis=1)
    assert 0.0 < np.median(distance) < 5e-4


def test_of_similar_grasps_the_best_come_first_and_the_best_of_another_kind_is_kept():
    T = np.tile(np.eye(4), (11, 1, 1))
    T[:, :3, 3] = (0.01, 0.01, 0.01)
    T[10, :3, 3] = (0.10, 0.01, 0.01)
    scores = np.append(np.linspace(0.9, 0.8, 10), 0.5)
    assert choose_grasps(T, scores, 3).tolist() == [0, 1, 10]
    assert choose_grasps(T, scores, 11).tolist() == list(range(11))


@pytest.mark.parametrize("n", [1, 7, 800])
def test_noise_is_finite_and_depends_on_the_seed(n):
    noise = draw_even_normal(n, 10, np.random.default_rng(3))
    assert noise.shape == (n, 10)
    assert np.isfinite(noise).all()
    assert (noise == draw_even_normal(n, 10, np.random.default_rng(3))).all()
    assert (noise != draw_even_normal(n, 10, np.random.default_rng(4))).any()


def test_noise_fills_its_space_more_evenly_than_independent_draws():
    even, independent = (
        draw_even_normal(800, 10, np.random.default_rng(0)),
        np.random.default_rng(0).normal(size=(800, 10)),
    )
    assert discrepancy(ndtr(even)) < 0.5 * discrepancy(ndtr(independent))
    assert even.std(axis=0) == pytest.approx(np.ones(10), abs=0.05)


@pytest.mark.integration
def test_a_batch_gives_the_same_grasps_as_single_clouds(sampler):
    clouds = [make_bottle_view(seed)[1] for seed in (0, 1, 2)]
    for points, grasps in zip(clouds, sampler.sample_batch(clouds, 40, 7), strict=True):
        alone = sampler.sample(points, 40, 7)
        assert np.array_equal(grasps.T_camera_grasps, alone.T_camera_grasps)
        assert np.array_equal(grasps.scores, alone.scores)


def test_a_batch_names_the_bad_cloud(sampler):
    good = make_bottle_view(0)[1]
    with raises(InvalidValueError, "cloud_extent") as caught:
        sampler.sample_batch([good, 1000.0 * good], 10, 0)
    assert "Cloud 1 of 2" in str(caught.value)
    with raises(InvalidValueError, "no_clouds"):
        sampler.sample_batch([], 10, 0)


def test_cuda_is_used_if_available_and_rejected_if_not():
    if torch.cuda.is_available():
        assert DiffusionSampler().device == "cuda"
    else:
        with raises(InvalidValueError, "no_cuda"):
            DiffusionSampler(DiffusionConfig(device="cuda"))


@pytest.mark.parametrize(
    ("points", "code"),
    [
        (np.zeros((0, 3)), "cloud_points"),
        (np.zeros((5, 3)), "cloud_points"),
        (np.zeros((100, 2)), "cloud_points"),
        (np.full((100, 3), np.inf), "cloud_not_finite"),
        (np.full((100, 3), np.nan), "cloud_not_finite"),
        (np.tile([0.0, 0.0, 0.4], (100, 1)), "cloud_extent"),
        (np.random.default_rng(0).normal(size=(100, 3)) * 30.0, "cloud_extent"),
    ],
)
def test_unusable_clouds_are_rejected(sampler, points, code):
    with raises(InvalidValueError, code):
        sampler.sample(points, 10, 0)


def test_invalid_settings_and_missing_weights_are_rejected(tmp_path):
    invalid: dict[str, Any] = {"steps": 0, "threads": 0, "temperature": 0.0, "oversampling": 0.5, "device": "tpu"}
    for setting, value in invalid.items():
        with raises(InvalidValueError, f"diffusion_{setting}") as caught:
            DiffusionConfig(**{setting: value})
        assert setting in str(caught.value) and str(value) in str(caught.value)
    with raises(WeightsError, "weights_missing"):
        DiffusionSampler(DiffusionConfig(weights=tmp_path / "none.npz"))


@pytest.mark.integration
def test_torch_is_not_imported_until_the_sampler_is_made():
    code = "import sys, z1_runtime.factory, models.diffusion.sampler; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
