"""The diffusion sampler with the weights that ship."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import ndtr
from scipy.stats.qmc import discrepancy

from models.diffusion.sampler import DiffusionConfig, DiffusionSampler, draw_even_normal
from models.diffusion.selection import choose_grasps
from models.diffusion.training.labels import GRIPPERS, check_grasps
from models.diffusion.training.shapes import make_shape
from models.diffusion.training.views import ViewConfig, render_view
from models.diffusion.weights import WeightsError

VIEW = ViewConfig(occluded_view_ratio=0.0, flying_point_ratio=0.0)


@pytest.fixture(scope="module")
def sampler() -> DiffusionSampler:
    return DiffusionSampler()


def a_bottle(seed: int):
    rng = np.random.default_rng(seed)
    solid = make_shape("bottle", rng)
    seen = render_view(solid, VIEW, rng)
    assert seen is not None
    return solid, *seen


def test_grasps_are_proper_scored_and_best_first(sampler):
    grasps = sampler.sample(a_bottle(0)[1], 100, 0)
    R = grasps.T_camera_grasps[:, :3, :3]
    assert len(grasps) == 100
    assert R @ R.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (100, 1, 1)), abs=1e-6)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert (np.diff(grasps.scores) <= 0.0).all()
    assert grasps.scores.min() >= 0.0 and grasps.scores.max() <= 1.0
    assert grasps.widths_m.min() > 0.0


def test_the_same_seed_gives_the_same_grasps_and_another_seed_others(sampler):
    points = a_bottle(0)[1]
    first, again, other = (sampler.sample(points, 50, seed) for seed in (3, 3, 4))
    assert np.array_equal(first.T_camera_grasps, again.T_camera_grasps)
    assert np.array_equal(first.scores, again.scores)
    assert not np.allclose(first.T_camera_grasps, other.T_camera_grasps)


def test_turning_the_camera_turns_the_grasps_and_nothing_else(sampler):
    points = a_bottle(1)[1]
    R = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    grasps, turned = sampler.sample(points, 60, 0), sampler.sample(points @ R.T, 60, 0)
    assert turned.scores == pytest.approx(grasps.scores, abs=1e-3)
    assert turned.T_camera_grasps[:10, :3, :3] == pytest.approx(R @ grasps.T_camera_grasps[:10, :3, :3], abs=2e-3)


def test_most_grasps_of_unseen_bottles_hold_and_the_best_scored_more_than_the_worst(sampler):
    raw, best, worst, width_errors = [], [], [], []
    for seed in range(50, 60):
        solid, points, T_camera_object = a_bottle(seed)
        grasps = sampler.sample(points, 200, 0)
        check = check_grasps(solid, np.linalg.inv(T_camera_object) @ grasps.T_camera_grasps, GRIPPERS["agnostic"])
        raw.append(check.valid.mean())
        best.append(check.valid[:50].mean())
        worst.append(check.valid[-50:].mean())
        width_errors.append(np.median(np.abs(grasps.widths_m - check.widths_m)[check.valid]))
    assert np.mean(raw) > 0.7
    assert np.mean(best) > np.mean(worst) + 0.1
    assert np.median(width_errors) < 0.012


def test_drawing_more_than_are_given_out_gives_better_ones_of_as_many_kinds(sampler):
    drawn_valid, chosen_valid, drawn_kinds, chosen_kinds = [], [], [], []
    for seed in range(70, 78):
        solid, points, T_camera_object = a_bottle(seed)
        T_object_camera = np.linalg.inv(T_camera_object)
        for grasps, valid, kinds in (
            (sampler.draw(points, 200, 0), drawn_valid, drawn_kinds),
            (sampler.sample(points, 200, 0), chosen_valid, chosen_kinds),
        ):
            good = check_grasps(solid, T_object_camera @ grasps.T_camera_grasps, GRIPPERS["agnostic"]).valid
            valid.append(good.mean())
            kinds.append(len(np.unique(np.round(2.0 * grasps.T_camera_grasps[good, :3, 2]), axis=0)))
    assert np.mean(chosen_valid) > np.mean(drawn_valid) + 0.03
    assert np.mean(chosen_kinds) > 0.97 * np.mean(drawn_kinds)


def test_bfloat16_moves_grasps_by_a_fraction_of_a_millimetre(sampler, monkeypatch):
    _, points, _ = a_bottle(70)
    places = []
    for quick in (False, True):
        monkeypatch.setattr(sampler, "_use_bfloat16", quick)
        places.append(sampler.draw(points, 200, 0).T_camera_grasps[:, :3, 3])
    apart = np.linalg.norm(places[0] - places[1], axis=1)
    assert 0.0 < np.median(apart) < 5e-4


def test_of_many_alike_the_best_go_first_and_the_best_of_another_kind_is_not_forgotten():
    T = np.tile(np.eye(4), (11, 1, 1))
    T[:, :3, 3] = (0.01, 0.01, 0.01)
    T[10, :3, 3] = (0.10, 0.01, 0.01)
    scores = np.append(np.linspace(0.9, 0.8, 10), 0.5)
    assert choose_grasps(T, scores, 3).tolist() == [0, 1, 10]  # the third of a kind is worth its score, no more
    assert choose_grasps(T, scores, 11).tolist() == list(range(11))


@pytest.mark.parametrize("n", [1, 7, 800])
def test_noise_is_normal_and_of_the_seed(n):
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


def test_several_objects_get_what_each_would_get_alone(sampler):
    clouds = [a_bottle(seed)[1] for seed in (0, 1, 2)]
    for points, grasps in zip(clouds, sampler.sample_batch(clouds, 40, 7), strict=True):
        alone = sampler.sample(points, 40, 7)
        assert np.array_equal(grasps.T_camera_grasps, alone.T_camera_grasps)
        assert np.array_equal(grasps.scores, alone.scores)


def test_a_batch_says_which_cloud_it_cannot_take(sampler):
    good = a_bottle(0)[1]
    with pytest.raises(ValueError, match=r"Cloud 1 of 2.*millimetres"):
        sampler.sample_batch([good, 1000.0 * good], 10, 0)
    with pytest.raises(ValueError, match="No cloud"):
        sampler.sample_batch([], 10, 0)


def test_cuda_is_used_when_there_and_refused_when_not():
    if torch.cuda.is_available():
        assert DiffusionSampler().device == "cuda"
    else:
        with pytest.raises(ValueError, match="no CUDA device"):
            DiffusionSampler(DiffusionConfig(device="cuda"))


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((0, 3)), "30 points"),
        (np.zeros((5, 3)), "30 points"),
        (np.zeros((100, 2)), "30 points"),
        (np.full((100, 3), np.inf), "infinite"),
        (np.full((100, 3), np.nan), "NaN"),
        (np.tile([0.0, 0.0, 0.4], (100, 1)), "spans"),
        (np.random.default_rng(0).normal(size=(100, 3)) * 30.0, "millimetres"),
    ],
)
def test_clouds_that_cannot_be_grasped_are_refused(sampler, points, message):
    with pytest.raises(ValueError, match=message):
        sampler.sample(points, 10, 0)


def test_nonsense_settings_and_missing_weights_are_refused(tmp_path):
    nonsense: dict[str, Any] = {"steps": 0, "threads": 0, "temperature": 0.0, "oversampling": 0.5, "device": "tpu"}
    for setting, value in nonsense.items():
        with pytest.raises(ValueError, match=setting):
            DiffusionConfig(**{setting: value})
    with pytest.raises(WeightsError, match="missing"):
        DiffusionSampler(DiffusionConfig(weights=tmp_path / "none.npz"))


def test_torch_is_not_imported_until_the_sampler_is_made():
    code = "import sys, z1_runtime.factory, models.diffusion.sampler; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
