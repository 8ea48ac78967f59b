"""Diversity: warnings and errors by the number of samples and their rotations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.errors import CalibrationError
from calibration.hand_eye.diversity import check_diversity, compute_diversity, compute_rotation_spread_deg
from hal.base.transforms import apply_increment
from tests.support.errors import raises


def rotated_poses(vectors_deg: np.ndarray) -> np.ndarray:
    Ts = np.tile(np.eye(4), (len(vectors_deg), 1, 1))
    Ts[:, :3, :3] = Rotation.from_rotvec(vectors_deg, degrees=True).as_matrix()
    return Ts


def about_one_axis(n: int, second_deg: float = 0.0) -> np.ndarray:
    vectors = np.outer(np.linspace(-40.0, 40.0, n), [0.0, 0.0, 1.0])
    vectors[:, 0] = second_deg * (-1.0) ** np.arange(n)
    return rotated_poses(vectors)


def spread(n: int, deg: float) -> np.ndarray:
    return rotated_poses(np.random.default_rng(1).uniform(-deg, deg, (n, 3)))


@pytest.mark.parametrize(
    ("Ts", "code"),
    [
        (spread(4, 40.0), "too_few_poses"),
        (spread(12, 1.0), "too_similar_poses"),
        (about_one_axis(12), "planar_rotations"),
    ],
    ids=["few", "similar", "planar"],
)
def test_unobservable_samples_are_rejected(Ts: np.ndarray, code: str) -> None:
    with raises(CalibrationError, code):
        check_diversity(Ts)


@pytest.mark.parametrize(
    ("Ts", "codes"),
    [
        (spread(20, 40.0), []),
        (spread(7, 40.0), ["too_few_poses"]),
        (spread(12, 6.0), ["too_similar_poses"]),
        (about_one_axis(12, 3.0), ["planar_rotations"]),
    ],
    ids=["good", "few", "similar", "planar"],
)
def test_weak_samples_give_a_warning(Ts: np.ndarray, codes: list[str]) -> None:
    assert [warning.code for warning in check_diversity(Ts)] == codes


def test_rotation_spread_is_descending_and_independent_of_the_anchor_frame() -> None:
    Ts = spread(10, 30.0)
    values = compute_rotation_spread_deg(Ts)
    assert (np.diff(values) <= 0.0).all()
    T_other = apply_increment(np.eye(4), np.array([1.0, 0.0, 0.0, 0.5, -0.3, 2.0]))
    np.testing.assert_allclose(compute_rotation_spread_deg(T_other @ Ts), values, rtol=1e-9)


def test_score_is_zero_about_one_axis_and_grows_with_the_second() -> None:
    assert compute_diversity(about_one_axis(12)) == pytest.approx(0.0, abs=1e-6)
    scores = [compute_diversity(about_one_axis(12, deg)) for deg in (1.0, 3.0, 10.0, 30.0)]
    assert (np.diff(scores) > 0.0).all()
    assert compute_diversity(spread(20, 60.0)) == 1.0
