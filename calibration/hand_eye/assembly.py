"""Assembly of the hand-eye result: refinement, closed forms for comparison, residuals and uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.errors import CalibrationWarning
from calibration.hand_eye.closed_forms import solve_closed_forms
from calibration.hand_eye.consistency import RobustFit
from calibration.hand_eye.diversity import compute_diversity
from calibration.hand_eye.pose_fit import (
    PoseData,
    PoseFit,
    compute_covariances,
    compute_leave_one_out,
    compute_residuals,
    predict_board_poses,
    solve_least_squares,
)
from calibration.hand_eye.refinement import Refinement, compute_reprojection_px, refine_jointly
from calibration.hand_eye.result import HandEyeResult, MethodResult, Setup
from calibration.hand_eye.uncertainty import compute_uncertainty


def make_result(
    data: PoseData,
    robust: RobustFit,
    *,
    setup: Setup,
    refine: Refinement | None,
    names: tuple[str, ...],
    square_m: float | None,
    dropped: dict[str, str],
    warnings: tuple[CalibrationWarning, ...],
) -> HandEyeResult:
    """Return the refined fit with its residuals and its uncertainty."""
    fit, kept = robust.fit, robust.kept
    methods = _solve_methods(data, kept, fit.scale)
    C = compute_covariances(data, fit, robust.noise)
    initial_px = px = None
    if refine is None:
        fit, P = solve_least_squares(data, fit, C, kept.astype(float), free_scale=False)
        # Row 0 is the scale's, which is not estimated here; those from 7 on are the board's
        covariance = P[1:7, 1:7]
    else:
        if methods:
            best = replace(
                fit, T_mount_camera=methods[0].T_mount_camera, Ts_anchor_board=methods[0].T_anchor_board[None]
            )
            initial_px = compute_reprojection_px(refine, predict_board_poses(data, best), fit.scale)
        fit, covariance = refine_jointly(refine, data, fit, robust.noise, kept)
        px = compute_reprojection_px(refine, predict_board_poses(data, fit), fit.scale)
    mm, deg = lengths_mm_deg(compute_residuals(data, fit))
    out_mm, out_deg = lengths_mm_deg(compute_leave_one_out(data, fit, C, kept, free_scale=False)[0][kept])
    corners = None if refine is None else np.array([len(view.ids) for view in refine.views])[kept]
    return HandEyeResult(
        setup=setup,
        T_mount_camera=fit.T_mount_camera,
        T_anchor_board=fit.Ts_anchor_board[0],
        covariance=covariance,
        uncertainty_mm=1e3 * compute_uncertainty(covariance[:3, :3], int(kept.sum())),
        uncertainty_deg=float(np.degrees(compute_uncertainty(covariance[3:, 3:], int(kept.sum())))),
        methods=methods,
        sample_names=names,
        residuals_mm=mm,
        residuals_deg=deg,
        residuals_px=px,
        initial_px=initial_px,
        rms_mm=_rms(mm[kept]),
        rms_deg=_rms(deg[kept]),
        # Weighted, as views differ in their number of corners
        rms_px=None if px is None or corners is None else float(np.sqrt(np.average(px[kept] ** 2, weights=corners))),
        holdout_mm=_rms(out_mm),
        holdout_deg=_rms(out_deg),
        diversity=compute_diversity(data.Ts_anchor_mount[kept]),
        square_m=square_m,
        noise=robust.noise,
        dropped=dropped,
        warnings=warnings,
    )


def lengths_mm_deg(e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lengths [mm] and angles [°] of residuals (N, 6)."""
    return 1e3 * np.linalg.norm(e[:, :3], axis=1), np.degrees(np.linalg.norm(e[:, 3:], axis=1))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _solve_methods(data: PoseData, kept: np.ndarray, scale: float) -> tuple[MethodResult, ...]:
    """Return the closed forms' results for the kept samples, best first."""
    boards = data.Ts_camera_board[kept].copy()
    boards[:, :3, 3] *= scale
    arm, found = data.Ts_anchor_mount[kept], []
    for name, T_mount_camera in solve_closed_forms(arm, boards):
        T_anchor_board = _mean_pose(arm @ T_mount_camera @ boards)
        fit = PoseFit(
            T_mount_camera=T_mount_camera,
            Ts_anchor_board=T_anchor_board[None],
            board_index=np.zeros(len(data), int),
            scale=scale,
        )
        mm, deg = lengths_mm_deg(compute_residuals(data, fit)[kept])
        found.append(
            MethodResult(
                name=name,
                T_mount_camera=T_mount_camera,
                T_anchor_board=T_anchor_board,
                rms_mm=_rms(mm),
                rms_deg=_rms(deg),
            )
        )
    return tuple(sorted(found, key=lambda method: method.rms_mm))


def _mean_pose(Ts: np.ndarray) -> np.ndarray:
    T = Ts.mean(axis=0)
    # A mean of rotation matrices is no rotation: the nearest one is their chordal mean
    U, _, Vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = U @ Vt
    return T
