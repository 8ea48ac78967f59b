"""Pose fit: derivatives, recovery of exact samples, noise levels, and a covariance that agrees with Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.hand_eye.pose_fit import (
    NoiseLevels,
    PoseData,
    PoseFit,
    compute_arm_jacobian,
    compute_covariances,
    compute_jacobian,
    compute_leave_one_out,
    compute_residuals,
    estimate_noise,
    solve_least_squares,
)
from hal.base.transforms import apply_increment, inverse, rotation_vectors
from tests.support.calibration_data import T_BASE_BOARD, T_FLANGE_CAMERA
from tests.support.hand_eye_problems import make_problem, true_fit

NOISE = NoiseLevels(arm_m=2e-4, arm_rad=3e-4)


def perturb(fit: PoseFit, x: np.ndarray) -> PoseFit:
    return replace(
        fit,
        scale=fit.scale + x[0],
        T_mount_camera=apply_increment(fit.T_mount_camera, x[1:7]),
        Ts_anchor_board=apply_increment(fit.Ts_anchor_board, x[7:].reshape(-1, 6)),
    )


def solve_kept(data: PoseData, start: PoseFit, *, free_scale: bool = False) -> tuple[PoseFit, np.ndarray]:
    C = compute_covariances(data, start, NOISE)
    return solve_least_squares(data, start, C, np.ones(len(data)), free_scale=free_scale)


@pytest.mark.parametrize("camera_on_flange", [True, False])
def test_residuals_of_the_ground_truth_are_zero(camera_on_flange: bool) -> None:
    data = make_problem(0, camera_on_flange=camera_on_flange)
    np.testing.assert_allclose(compute_residuals(data, true_fit(len(data))), 0.0, atol=1e-7)


def test_jacobian_is_the_derivative_of_the_residuals() -> None:
    data = make_problem(1, 6)
    index = np.array([0, 0, 0, 1, 1, 1])
    fit = replace(true_fit(6), Ts_anchor_board=np.stack([T_BASE_BOARD, T_BASE_BOARD]), board_index=index)
    J = compute_jacobian(data, fit)
    for column in range(J.shape[2]):
        x = np.zeros(J.shape[2])
        x[column] = 1e-6
        numeric = (compute_residuals(data, perturb(fit, x)) - compute_residuals(data, perturb(fit, -x))) / 2e-6
        np.testing.assert_allclose(J[:, :, column], numeric, atol=1e-6)


@pytest.mark.parametrize("camera_on_flange", [True, False])
def test_arm_jacobian_is_the_derivative_by_the_flange(camera_on_flange: bool) -> None:
    data, fit = make_problem(2, 5, camera_on_flange=camera_on_flange), true_fit(5)
    M = compute_arm_jacobian(data, fit)
    for column in range(6):
        x = np.zeros(6)
        x[column] = 1e-6
        if camera_on_flange:
            moved = replace(data, Ts_anchor_mount=apply_increment(data.Ts_anchor_mount, x))
        else:
            moved = replace(data, Ts_anchor_mount=inverse(apply_increment(inverse(data.Ts_anchor_mount), x)))
        numeric = compute_residuals(moved, fit) / 1e-6
        sign = -1.0 if camera_on_flange else 1.0
        np.testing.assert_allclose(sign * M[:, :, column], numeric, atol=1e-5)


@pytest.mark.parametrize("camera_on_flange", [True, False])
def test_exact_samples_give_the_exact_poses_from_a_bad_start(camera_on_flange: bool) -> None:
    data = make_problem(3, camera_on_flange=camera_on_flange)
    start = perturb(true_fit(len(data)), np.array([0.0, *[0.01] * 3, *[0.05] * 3, *[-0.02] * 3, *[0.04] * 3]))
    fit, _ = solve_kept(data, start)
    np.testing.assert_allclose(fit.T_mount_camera, T_FLANGE_CAMERA, atol=1e-8)
    np.testing.assert_allclose(fit.Ts_anchor_board[0], T_BASE_BOARD, atol=1e-8)


def test_board_scale_is_recovered() -> None:
    data = make_problem(4)
    scaled = data.Ts_camera_board.copy()
    scaled[:, :3, 3] /= 1.03  # a pose estimated with squares that are 3 % too small
    fit, _ = solve_kept(replace(data, Ts_camera_board=scaled), true_fit(len(data)), free_scale=True)
    assert fit.scale == pytest.approx(1.03, abs=1e-4)


def test_sample_without_weight_has_no_influence() -> None:
    data = make_problem(5)
    arm = data.Ts_anchor_mount.copy()
    arm[2, :3, 3] += 0.5
    weights = np.ones(len(data))
    weights[2] = 0.0
    start = true_fit(len(data))
    C = compute_covariances(data, start, NOISE)
    fit, _ = solve_least_squares(replace(data, Ts_anchor_mount=arm), start, C, weights, free_scale=False)
    np.testing.assert_allclose(fit.T_mount_camera, T_FLANGE_CAMERA, atol=1e-8)


@pytest.mark.integration
def test_covariance_agrees_with_monte_carlo() -> None:
    errors, P = [], np.zeros(0)
    for seed in range(60):
        noisy = make_problem(seed, arm_m=NOISE.arm_m, arm_rad=NOISE.arm_rad)
        # The same views each time: only the noise differs
        exact = make_problem(0)
        eta = inverse(make_problem(seed).Ts_anchor_mount) @ noisy.Ts_anchor_mount
        data = replace(exact, Ts_anchor_mount=exact.Ts_anchor_mount @ eta)
        fit, P = solve_kept(data, true_fit(len(data)))
        T = inverse(T_FLANGE_CAMERA) @ fit.T_mount_camera
        errors.append([*T[:3, 3], *rotation_vectors(T[:3, :3])])
    ratio = np.std(errors, axis=0) / np.sqrt(np.diag(P)[1:7])
    # The standard deviation of 60 draws is known to 9 %: four of those
    assert (np.abs(ratio - 1.0) < 0.37).all(), ratio


@pytest.mark.parametrize("camera_on_flange", [True, False])
def test_noise_levels_are_estimated(camera_on_flange: bool) -> None:
    data = make_problem(6, 60, arm_m=NOISE.arm_m, arm_rad=NOISE.arm_rad, camera_on_flange=camera_on_flange)
    start = true_fit(len(data))
    fit, _ = solve_least_squares(
        data, start, compute_covariances(data, start, NOISE), np.ones(len(data)), free_scale=False
    )
    found = estimate_noise(data, fit, np.ones(len(data), bool), NoiseLevels(), free_scale=False)
    assert found.arm_m == pytest.approx(NOISE.arm_m, rel=0.35)
    assert found.arm_rad == pytest.approx(NOISE.arm_rad, rel=0.35)


def test_leave_one_out_equals_a_solution_without_the_sample() -> None:
    data = make_problem(7, 8, arm_m=NOISE.arm_m, arm_rad=NOISE.arm_rad)
    fit, _ = solve_kept(data, true_fit(8))
    C = compute_covariances(data, fit, NOISE)
    e_out, C_out = compute_leave_one_out(data, fit, C, np.ones(8, bool), free_scale=False)
    for i in range(8):
        weights = np.ones(8)
        weights[i] = 0.0
        without, _ = solve_least_squares(data, fit, C, weights, free_scale=False)
        np.testing.assert_allclose(e_out[i], compute_residuals(data, without)[i], rtol=0.02, atol=1e-6)
        assert np.linalg.eigvalsh(C_out[i] - C[i]).min() > -1e-15
