"""Uncertainty: the radius covers errors of the covariance with the stated probability."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi, norm

from calibration.hand_eye.uncertainty import COVERAGE, compute_uncertainty


def test_isotropic_radius_is_that_of_the_chi_distribution() -> None:
    assert compute_uncertainty(4.0 * np.eye(3), 10**6) == pytest.approx(2.0 * chi.ppf(COVERAGE, 3), rel=1e-3)


def test_radius_along_one_axis_is_that_of_the_normal_distribution() -> None:
    covariance = np.diag([9.0, 0.0, 0.0])
    assert compute_uncertainty(covariance, 10**6) == pytest.approx(3.0 * norm.ppf(0.5 + COVERAGE / 2), rel=1e-3)


@pytest.mark.parametrize("variances", [(1.0, 1.0, 1.0), (4.0, 1.0, 0.25), (100.0, 1.0, 1.0)])
def test_radius_covers_random_errors(variances: tuple[float, ...]) -> None:
    errors = np.random.default_rng(0).normal(size=(40_000, 3)) * np.sqrt(variances)
    covered = (np.linalg.norm(errors, axis=1) < compute_uncertainty(np.diag(variances), 10**6)).mean()
    assert covered == pytest.approx(COVERAGE, abs=0.004)


def test_few_samples_widen_the_radius_and_rotations_of_the_axes_do_not() -> None:
    covariance = np.diag([4.0, 1.0, 0.25])
    radii = [compute_uncertainty(covariance, n) for n in (5, 10, 20, 1000)]
    assert (np.diff(radii) < 0.0).all()
    Q = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    assert compute_uncertainty(Q @ covariance @ Q.T, 20) == pytest.approx(radii[2])


def test_no_covariance_gives_no_radius() -> None:
    assert compute_uncertainty(np.zeros((3, 3)), 20) == 0.0
