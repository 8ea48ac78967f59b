"""Least squares over poses: the hand-eye transform, the board's poses (before and after a move), and its scale.

A sample's residual e = (position [m], rotation vector [rad]), in camera axes, is the difference between the board
predicted through the arm and the detected board. Its covariance has two parts: the noise of the corners (the inverse
of their Fisher information) and the scatter of the flange's pose by `NoiseLevels`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from hal.base.transforms import apply_increment, inverse, rotation_vectors, skew

_SCALE_SD = 0.1  # prior of the board's scale: a print that is off by more than a tenth is noticed
_MIN_SCATTER = 1e-6  # [m] and [rad]; an ideal arm would make the weights infinite
_MAX_SCATTER = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseData:
    """The samples as poses, for either setup."""

    Ts_anchor_mount: np.ndarray
    """(N, 4, 4) the arm's poses."""
    Ts_camera_board: np.ndarray
    """(N, 4, 4) the detected board poses."""
    corner_covariances: np.ndarray
    """(N, 6, 6) of position and rotation of the board in camera axes, from the noise of the corners."""
    camera_on_flange: bool
    """True where the flange is the mount (eye in hand), False where it is the anchor (eye to hand)."""

    def __len__(self) -> int:
        return len(self.Ts_anchor_mount)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseFit:
    """The unknowns."""

    T_mount_camera: np.ndarray
    """(4, 4)."""
    Ts_anchor_board: np.ndarray
    """(G, 4, 4), one for each placement of the board."""
    board_index: np.ndarray
    """(N,) int, index into `Ts_anchor_board` of each sample."""
    scale: float = 1.0
    """True size of the board over that of the settings."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseLevels:
    """Standard deviations of the flange's pose along and about each axis."""

    arm_m: float = 5e-4
    arm_rad: float = 1e-3


def predict_board_poses(data: PoseData, fit: PoseFit) -> np.ndarray:
    """Return T_camera_board (N, 4, 4) of each sample as predicted through the arm."""
    return inverse(data.Ts_anchor_mount @ fit.T_mount_camera) @ fit.Ts_anchor_board[fit.board_index]


def compute_residuals(data: PoseData, fit: PoseFit) -> np.ndarray:
    """Return the residuals e (N, 6): position [m] and rotation vector [rad] in camera axes."""
    predicted, detected = predict_board_poses(data, fit), data.Ts_camera_board
    R = predicted[:, :3, :3] @ np.swapaxes(detected[:, :3, :3], 1, 2)
    return np.hstack([predicted[:, :3, 3] - fit.scale * detected[:, :3, 3], rotation_vectors(R)])


def compute_jacobian(data: PoseData, fit: PoseFit) -> np.ndarray:
    """Return the Jacobian (N, 6, 7 + 6 G) of e by the scale, the camera's ξ, and the ξ of each board pose."""
    predicted = predict_board_poses(data, fit)
    n, n_boards = len(data), len(fit.Ts_anchor_board)
    J = np.zeros((n, 6, 7 + 6 * n_boards))
    J[:, :3, 0] = -data.Ts_camera_board[:, :3, 3]
    J[:, :3, 1:4] = J[:, 3:, 4:7] = -np.eye(3)
    J[:, :3, 4:7] = skew(predicted[:, :3, 3])
    for i, board_index in enumerate(fit.board_index):
        column = 7 + 6 * board_index
        J[i, :3, column : column + 3] = J[i, 3:, column + 3 : column + 6] = predicted[i, :3, :3]
    return J


def compute_arm_jacobian(data: PoseData, fit: PoseFit) -> np.ndarray:
    """Return the Jacobian (N, 6, 6) of e by a small motion of the flange in its own axes, up to the sign."""
    R_camera_mount = fit.T_mount_camera[:3, :3].T
    boards = fit.Ts_anchor_board[fit.board_index]
    if data.camera_on_flange:
        R = np.broadcast_to(R_camera_mount, (len(data), 3, 3))
        lever = (inverse(data.Ts_anchor_mount) @ boards)[:, :3, 3]
    else:
        R = R_camera_mount @ np.swapaxes(data.Ts_anchor_mount[:, :3, :3], 1, 2)
        lever = boards[:, :3, 3]
    M = np.zeros((len(data), 6, 6))
    M[:, :3, :3] = M[:, 3:, 3:] = R
    M[:, :3, 3:] = -R @ skew(lever)
    return M


def compute_covariances(data: PoseData, fit: PoseFit, noise: NoiseLevels) -> np.ndarray:
    """Return the covariance (N, 6, 6) of each sample's e."""
    M = compute_arm_jacobian(data, fit)
    arm = np.repeat([noise.arm_m**2, noise.arm_rad**2], 3)
    return data.corner_covariances + (M * arm) @ np.swapaxes(M, 1, 2)


def solve_least_squares(
    data: PoseData, fit: PoseFit, C: np.ndarray, weights: np.ndarray, *, free_scale: bool, rounds: int = 10
) -> tuple[PoseFit, np.ndarray]:
    """Return the weighted least-squares fit, and the covariance of (scale, camera ξ, board ξ …).

    Args:
        data: the samples.
        fit: initial values.
        C: (N, 6, 6) covariances of e.
        weights: (N,) of the samples, 0 … 1.
        free_scale: whether the board's scale is estimated; else its row and column of the covariance are 0.
        rounds: maximum of Gauss-Newton steps.
    """
    W = np.linalg.inv(C) * weights[:, None, None]
    P = np.zeros((0, 0))
    for _ in range(rounds):
        e, J = compute_residuals(data, fit), compute_jacobian(data, fit)
        step, P = _step(e, J, W, fit, free_scale)
        n_boards = len(fit.Ts_anchor_board)
        fit = replace(
            fit,
            scale=fit.scale + float(step[0]),
            T_mount_camera=apply_increment(fit.T_mount_camera, step[1:7]),
            Ts_anchor_board=np.stack(
                [
                    apply_increment(T, step[7 + 6 * g : 13 + 6 * g])
                    for g, T in zip(range(n_boards), fit.Ts_anchor_board, strict=True)
                ]
            ),
        )
        if np.abs(step).max() < 1e-10:
            break
    return fit, P


def _step(e: np.ndarray, J: np.ndarray, W: np.ndarray, fit: PoseFit, free_scale: bool) -> tuple[np.ndarray, np.ndarray]:
    H, g = _normal_equations(e, J, W)
    H[0, 0] += _SCALE_SD**-2
    g[0] += (fit.scale - 1.0) * _SCALE_SD**-2
    used = np.arange(0 if free_scale else 1, len(g))
    P = np.zeros_like(H)
    # The pseudo-inverse keeps a board pose where it is when all samples of its group have the weight 0
    P[np.ix_(used, used)] = np.linalg.pinv(H[np.ix_(used, used)], rcond=1e-15, hermitian=True)
    return -P @ g, P


def _normal_equations(e: np.ndarray, J: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    weighted, rows = (W @ J).reshape(-1, J.shape[2]), J.reshape(-1, J.shape[2])
    return rows.T @ weighted, weighted.T @ e.ravel()


def compute_squared_distances(e: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return the squared Mahalanobis distances (N,) of residuals e (N, 6)."""
    return np.einsum("ni,ni->n", e, np.linalg.solve(C, e[..., None])[..., 0])


def estimate_noise(
    data: PoseData, fit: PoseFit, kept: np.ndarray, start: NoiseLevels, *, free_scale: bool
) -> NoiseLevels:
    """Return the scatter of the arm most likely to cause the residuals of the samples `kept` (N,) bool.

    Restricted maximum likelihood (REML), which accounts for the part of the residuals that the fit absorbs.
    """
    e, J = compute_residuals(data, fit)[kept], compute_jacobian(data, fit)[kept]
    M, corner = compute_arm_jacobian(data, fit)[kept], data.corner_covariances[kept]
    J = J[:, :, 0 if free_scale else 1 :]

    def deviance(log_scatter: np.ndarray) -> float:
        arm = np.repeat(np.exp(2.0 * log_scatter), 3)
        C = corner + (M * arm) @ np.swapaxes(M, 1, 2)
        W = np.linalg.inv(C)
        H, g = _normal_equations(e, J, W)
        misfit = np.einsum("ni,nij,nj->", e, W, e) - g @ np.linalg.lstsq(H, g, rcond=None)[0]
        # Minus twice the restricted log-likelihood (Patterson and Thompson 1971), up to a constant
        return float(misfit + np.linalg.slogdet(C)[1].sum() + np.linalg.slogdet(H)[1])

    best = minimize(
        deviance,
        # Logarithms keep both positive
        np.log([start.arm_m, start.arm_rad]),
        method="Nelder-Mead",
        bounds=[(np.log(_MIN_SCATTER), np.log(_MAX_SCATTER))] * 2,
        # 2 % of a scatter is below its own uncertainty: 9 % from 60 residuals
        options={"xatol": 0.02, "fatol": 0.01, "maxfev": 120},
    )
    arm_m, arm_rad = np.exp(best.x)
    return NoiseLevels(arm_m=float(arm_m), arm_rad=float(arm_rad))


def compute_leave_one_out(
    data: PoseData, fit: PoseFit, C: np.ndarray, kept: np.ndarray, *, free_scale: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return each sample's residual (N, 6) under the solution of the others kept, and its covariance (N, 6, 6)."""
    e, J, W = compute_residuals(data, fit), compute_jacobian(data, fit), np.linalg.inv(C)
    e_out, C_out = np.empty_like(e), np.empty_like(C)
    for i in range(len(data)):
        others = kept.copy()
        others[i] = False
        step, P = _step(e[others], J[others], W[others], fit, free_scale)
        e_out[i] = e[i] + J[i] @ step
        C_out[i] = C[i] + J[i] @ P @ J[i].T
    return e_out, C_out
