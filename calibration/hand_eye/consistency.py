"""Consistency of the samples: outliers, a board that moved between two samples, poses in a wrong order."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f as f_distribution

from calibration.hand_eye.closed_forms import estimate_initial_poses
from calibration.hand_eye.pose_fit import (
    NoiseLevels,
    PoseData,
    PoseFit,
    compute_covariances,
    compute_leave_one_out,
    compute_residuals,
    compute_squared_distances,
    estimate_noise,
    solve_least_squares,
)
from calibration.pose_checks import pose_distances_mm_deg
from hal.base.transforms import inverse

# Squared distance beyond which a sample has no weight: 1 of 3000 inliers (chi square, 6 degrees of freedom) exceeds it
_CUTOFF = 25.0
_MEDIAN = 5.348  # of chi square with 6 degrees of freedom
_FALSE_ALARM = 1e-4  # probability that an inlier is dropped
_MIN_MOVE_GAIN = 50.0  # in squared distances; a second board pose has 6 parameters, which alone gain 6 from noise
_MIN_GROUP = 3  # samples on either side of a move
_MIN_MOVE_MM, _MIN_MOVE_DEG = 1.0, 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobustFit:
    """A fit to the inliers."""

    fit: PoseFit
    """The unknowns, from the samples kept."""
    noise: NoiseLevels
    """Scatter of the arm."""
    kept: np.ndarray
    """(N,) bool."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardMove:
    """A displacement of the board between two samples."""

    first: int
    """Index of the first sample after the move."""
    mm: float
    """Distance [mm]."""
    deg: float
    """Angle [°]."""


def make_initial_fit(data: PoseData) -> PoseFit:
    """Return initial values from a robust closed form."""
    T_mount_camera, T_anchor_board, _ = estimate_initial_poses(data.Ts_anchor_mount, data.Ts_camera_board)
    return PoseFit(
        T_mount_camera=T_mount_camera, Ts_anchor_board=T_anchor_board[None], board_index=np.zeros(len(data), dtype=int)
    )


def solve_reweighted(
    data: PoseData, fit: PoseFit, noise: NoiseLevels, *, rounds: int = 15
) -> tuple[PoseFit, np.ndarray]:
    """Return the fit by iteratively reweighted least squares (Tukey's weights), and the squared distances (N,)."""
    # The fit absorbs part of the residuals: equations over degrees of freedom
    inflation = 6 * len(data) / (6 * len(data) - 6 - 6 * len(fit.Ts_anchor_board))
    for _ in range(rounds):
        C = compute_covariances(data, fit, noise)
        d2 = compute_squared_distances(compute_residuals(data, fit), C)
        scale = max(1e-9, inflation * float(np.median(d2)) / _MEDIAN)
        # The biweight of Beaton and Tukey (1974)
        weights = np.clip(1.0 - d2 / (_CUTOFF * scale), 0.0, None) ** 2
        before, (fit, _) = fit, solve_least_squares(data, fit, C, weights, free_scale=True, rounds=1)
        if max(np.max(part) for part in pose_distances_mm_deg(before.T_mount_camera, fit.T_mount_camera)) < 1e-4:
            break
    return fit, compute_squared_distances(compute_residuals(data, fit), compute_covariances(data, fit, noise))


def fit_robust(data: PoseData, fit: PoseFit, *, free_scale: bool = True) -> RobustFit:
    """Return the fit to all inliers, with the arm's noise estimated from them.

    A sample is tested against the solution of all others, so that an outlier does not bias its own test; a sample
    dropped in an early round may return.
    """
    robust, d2 = solve_reweighted(data, fit, NoiseLevels())
    fit = robust if free_scale else replace(robust, scale=fit.scale)
    # A first guess with the default noise, therefore with twice the cut-off; the tests below decide
    kept = d2 < _CUTOFF * max(1e-9, float(np.median(d2)) / _MEDIAN) * 2.0
    noise = NoiseLevels()
    tested: set[bytes] = set()
    # A sample dropped may bring another one back: the loop ends when a set recurs
    while kept.tobytes() not in tested:
        tested.add(kept.tobytes())
        for _ in range(2):  # the residuals determine the noise, and the noise their weights
            noise = estimate_noise(data, fit, kept, noise, free_scale=free_scale)
            C = compute_covariances(data, fit, noise)
            fit, _ = solve_least_squares(data, fit, C, kept.astype(float), free_scale=free_scale)
        d2 = compute_squared_distances(*compute_leave_one_out(data, fit, C, kept, free_scale=free_scale))
        # F instead of chi square, as the noise is estimated from the same samples
        limit = 6.0 * f_distribution.ppf(1.0 - _FALSE_ALARM, 6, max(3 * (int(kept.sum()) - 2), 3))
        kept = d2 < limit
    return RobustFit(fit=fit, noise=noise, kept=kept)


def detect_board_move(data: PoseData, fit: PoseFit) -> BoardMove | None:
    """Return the most likely move of the board in the sequence; None when no move explains the samples better."""
    noise = NoiseLevels()
    gain, best, index = _best_split(data, fit, noise)
    # Default noise that is too large lowers the gain: the full limit applies after the noise is estimated
    if best is None or gain < 0.2 * _MIN_MOVE_GAIN:
        return None
    near = compute_squared_distances(compute_residuals(data, best), compute_covariances(data, best, noise)) < _CUTOFF
    estimated = estimate_noise(data, best, near, noise, free_scale=True)
    noise = NoiseLevels(arm_m=max(estimated.arm_m, 1e-4), arm_rad=max(estimated.arm_rad, 2e-4))
    gain, best, index = _best_split(data, fit, noise)
    if best is None or gain < _MIN_MOVE_GAIN:
        return None
    mm, deg = pose_distances_mm_deg(*best.Ts_anchor_board)
    if mm < max(_MIN_MOVE_MM, 3e3 * noise.arm_m) and deg < max(_MIN_MOVE_DEG, np.degrees(3 * noise.arm_rad)):
        return None
    return BoardMove(first=index, mm=float(mm), deg=float(deg))


def _best_split(data: PoseData, fit: PoseFit, noise: NoiseLevels) -> tuple[float, PoseFit | None, int]:
    """Return the gain of a second board pose in squared distances, its fit, and its first sample."""
    _, d2 = solve_reweighted(data, fit, noise)
    # Truncated, so that one outlier does not justify a second board pose
    one = np.minimum(d2, _CUTOFF).sum()
    gain, best, index = 0.0, None, 0
    for first in range(_MIN_GROUP, len(data) - _MIN_GROUP + 1):
        group = (np.arange(len(data)) >= first).astype(int)
        boards = data.Ts_anchor_mount @ fit.T_mount_camera @ data.Ts_camera_board
        medoids = np.stack([_medoid(boards[group == g]) for g in range(2)])
        start = replace(fit, Ts_anchor_board=medoids, board_index=group)
        two, d2 = solve_reweighted(data, start, noise, rounds=5)
        near = d2 < _CUTOFF
        if min(near[:first].sum(), near[first:].sum()) < _MIN_GROUP:
            continue
        if one - np.minimum(d2, _CUTOFF).sum() > gain:
            gain, best, index = float(one - np.minimum(d2, _CUTOFF).sum()), two, first
    return gain, best, index


def _medoid(boards: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) nearest to the others."""
    mm, deg = pose_distances_mm_deg(boards[:, None], boards[None])
    # The median over the others keeps an outlier from moving the result
    return boards[np.argmin(np.median(mm + 5.0 * deg, axis=1))]


def diagnose_pose_order(Ts_anchor_mount: np.ndarray, Ts_camera_board: np.ndarray) -> str | None:
    """Return the mistake in the poses that explains inconsistent samples; None when none does."""
    A, B = Ts_anchor_mount, Ts_camera_board
    mistakes = {
        "the arm's poses are inverted (T_flange_base was given for T_base_flange, or the other setup is meant)": (
            inverse(A),
            B,
        ),
        "the board's poses are inverted (T_board_camera was given for T_camera_board)": (A, inverse(B)),
        "one of the two lists is reversed": (A, B[::-1]),
        "each image belongs to the arm's previous pose": (A[:-1], B[1:]),
        "each image belongs to the arm's next pose": (A[1:], B[:-1]),
    }
    as_given = estimate_initial_poses(A, B)[2]
    error_mm = {mistake: estimate_initial_poses(*poses)[2] for mistake, poses in mistakes.items()}
    best = min(error_mm, key=lambda mistake: error_mm[mistake])
    return best if error_mm[best] < 0.2 * as_given else None
