"""Joint refinement: exact corners give the exact camera, its Jacobian is right, and its noise estimates hold."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.hand_eye.pose_fit import NoiseLevels, PoseData, PoseFit, predict_board_poses
from calibration.hand_eye.refinement import (
    _Bundle,
    compute_reprojection_px,
    estimate_corner_covariances,
    estimate_corner_noise_px,
    refine_jointly,
)
from hal.base.transforms import apply_increment, inverse, rotation_vectors
from tests.support.calibration_data import T_BASE_BOARD, T_FLANGE_CAMERA, Recording, record

NOISE = NoiseLevels(arm_m=1e-4, arm_rad=2e-4)


def problem_of(recording: Recording, *, camera_on_flange: bool = True) -> tuple[PoseData, PoseFit]:
    """Return the samples and a fit 1 mm and 3 mrad from the ground truth; without a camera on the flange, swapped."""
    n = len(recording.views)
    data = PoseData(
        Ts_anchor_mount=recording.Ts_base_flange,
        Ts_camera_board=recording.Ts_camera_board,
        corner_covariances=np.zeros((n, 6, 6)),
        camera_on_flange=camera_on_flange,
    )
    step = np.array([1e-3, -1e-3, 1e-3, 3e-3, 3e-3, -3e-3])
    fit = PoseFit(
        T_mount_camera=apply_increment(T_FLANGE_CAMERA, step),
        Ts_anchor_board=apply_increment(T_BASE_BOARD, -step)[None],
        board_index=np.zeros(n, int),
    )
    return data, fit


@pytest.mark.integration
@pytest.mark.parametrize("camera_on_flange", [True, False])
def test_exact_corners_give_the_exact_camera_in_few_steps(
    camera_on_flange: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exact corners make all residuals of the start large: with the final Huber limit alone it takes 600 steps."""
    evaluations, residuals = [], _Bundle.residuals
    monkeypatch.setattr(_Bundle, "residuals", lambda self, x: evaluations.append(1) or residuals(self, x))
    recording = record(0, 8, corner_px=0.0, arm_m=0.0, arm_deg=0.0)
    data, start = problem_of(recording, camera_on_flange=camera_on_flange)
    kept = np.ones(8, bool)
    fit, covariance = refine_jointly(recording.refine, data, start, NOISE, kept)
    np.testing.assert_allclose(fit.T_mount_camera, T_FLANGE_CAMERA, atol=1e-6)
    np.testing.assert_allclose(fit.Ts_anchor_board[0], T_BASE_BOARD, atol=1e-6)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert compute_reprojection_px(recording.refine, predict_board_poses(data, fit), 1.0).max() < 1e-2
    assert len(evaluations) < 60


@pytest.mark.integration
@pytest.mark.parametrize("camera_on_flange", [True, False])
def test_jacobian_is_the_derivative_of_the_residuals(camera_on_flange: bool) -> None:
    recording = record(1, 5)
    data, fit = problem_of(recording, camera_on_flange=camera_on_flange)
    bundle = _Bundle(recording.refine, data, fit, NOISE, np.arange(5))
    x = np.zeros(12 + 30)
    J = bundle.compute_jacobian(x)
    for column in range(len(x)):
        step = np.zeros(len(x))
        step[column] = 1e-7
        numeric = (bundle.residuals(step) - bundle.residuals(-step)) / 2e-7
        np.testing.assert_allclose(J[:, column], numeric, rtol=1e-4, atol=1e-4 * np.abs(J).max())


@pytest.mark.integration
def test_dropped_samples_have_no_influence() -> None:
    recording = record(2, 10)
    data, start = problem_of(recording)
    kept = np.arange(10) != 4
    expected, _ = refine_jointly(recording.refine, data, start, NOISE, kept)
    recording.views[4].pixels_px[:] += 30.0
    found, _ = refine_jointly(recording.refine, data, start, NOISE, kept)
    # The noise of the corners is a median over all views, which one of ten shifts a little
    np.testing.assert_allclose(found.T_mount_camera, expected.T_mount_camera, atol=2e-5)


@pytest.mark.integration
def test_covariance_covers_the_errors_of_many_captures() -> None:
    squared = []
    for seed in range(6):
        recording = record(seed, 10, arm_m=NOISE.arm_m, arm_deg=np.degrees(NOISE.arm_rad))
        data, start = problem_of(recording)
        fit, covariance = refine_jointly(recording.refine, data, start, NOISE, np.ones(10, bool))
        T = inverse(T_FLANGE_CAMERA) @ fit.T_mount_camera
        xi = np.array([*T[:3, 3], *rotation_vectors(T[:3, :3])])
        squared.append(xi @ np.linalg.solve(covariance, xi))
    # A sum of 6 chi squares of 6 degrees of freedom has the mean 36 and the standard deviation 8.5
    assert 14.0 < np.sum(squared) < 70.0


@pytest.mark.parametrize("corner_px", [0.05, 0.3])
def test_corner_noise_is_estimated(corner_px: float) -> None:
    recording = record(3, 12, corner_px=corner_px)
    found = estimate_corner_noise_px(recording.refine, recording.Ts_camera_board)
    assert found == pytest.approx(corner_px, rel=0.15)


def test_corner_covariances_grow_with_the_square_of_the_noise_and_agree_with_the_poses() -> None:
    exact = record(4, 12, corner_px=0.0, arm_m=0.0, arm_deg=0.0)
    C = estimate_corner_covariances(record(4, 12, corner_px=0.2).refine, exact.Ts_camera_board)
    squared = []
    for seed in range(5):
        noisy = record(seed, 12, corner_px=0.2, arm_m=0.0, arm_deg=0.0, Ts_camera_board=exact.Ts_camera_board)
        for view, true in zip(noisy.views, exact.views, strict=True):
            assert len(view.ids) == len(true.ids)
        e = np.hstack(
            [
                noisy.Ts_camera_board[:, :3, 3] - exact.Ts_camera_board[:, :3, 3],
                rotation_vectors(
                    noisy.Ts_camera_board[:, :3, :3] @ np.swapaxes(exact.Ts_camera_board[:, :3, :3], 1, 2)
                ),
            ]
        )
        squared += np.einsum("ni,ni->n", e, np.linalg.solve(C, e[..., None])[..., 0]).tolist()
    assert 3.0 < np.mean(squared) < 12.0  # chi square with 6 degrees of freedom has the mean 6
