"""Hand-eye calibration: the camera's pose on the arm's flange (eye in hand) or in the base (eye to hand).

Both are one problem. Call *mount* the frame that carries the camera and *anchor* the frame that carries the board:
flange and base for an eye in hand, base and flange for an eye to hand. Then for every sample
    T_anchor_mount · T_mount_camera · T_camera_board = T_anchor_board
with T_mount_camera and T_anchor_board unknown and constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.board.pose import check_view
from calibration.errors import CalibrationError, CalibrationWarning
from calibration.hand_eye.assembly import lengths_mm_deg, make_result
from calibration.hand_eye.consistency import (
    BoardMove,
    RobustFit,
    detect_board_move,
    diagnose_pose_order,
    fit_robust,
    make_initial_fit,
)
from calibration.hand_eye.diversity import MIN_POSES, check_diversity
from calibration.hand_eye.pose_fit import (
    PoseData,
    PoseFit,
    compute_covariances,
    compute_residuals,
    solve_least_squares,
)
from calibration.hand_eye.refinement import Refinement, estimate_corner_covariances
from calibration.hand_eye.result import HandEyeResult, Setup
from calibration.pose_checks import check_poses
from hal.base.transforms import inverse

WRONG_SCALE = 0.005
"""Squares whose size differs from the settings by more than this ratio get the warning `wrong_square_size`."""

_MAX_SCATTER_MM, _MAX_SCATTER_DEG = 10.0, 2.0  # more is no scatter of an arm and a camera, but a mistake
_MAX_DROPPED_RATIO = 0.4


def solve_hand_eye(
    Ts_base_flange: np.ndarray,
    Ts_camera_board: np.ndarray,
    *,
    setup: Setup = "eye_in_hand",
    refine: Refinement | None = None,
    names: Sequence[str] | None = None,
) -> HandEyeResult:
    """Return the camera's pose from N samples in the order of their capture.

    Args:
        Ts_base_flange: (N, 4, 4) the arm's pose at each sample, by its own kinematics.
        Ts_camera_board: (N, 4, 4) the board's pose detected in each, by `estimate_board_pose`.
        setup: whether the arm carries the camera or the board.
        refine: refine camera and board pose jointly by the reprojection error; weights and uncertainty then follow
            from the noise of the corners and the scatter of the arm, which is estimated from the samples.
        names: of the samples, for messages ("1", "2", … when None).

    Raises:
        CalibrationError: `too_few_poses`, `too_similar_poses`, `planar_rotations`, `flipped_order` (poses inverted or
            in another order), `inconsistent` (no camera pose explains the samples), `board_moved` (too few samples
            on either side of the move), `bad_poses` (shapes, names, or no rigid transforms).
    """
    data = _pose_data(Ts_base_flange, Ts_camera_board, setup, refine)
    names = _check_names(names, len(data))
    warnings = check_diversity(data.Ts_anchor_mount)
    # Before the outliers are dropped: after a move all samples of one side are outliers to the other
    move = detect_board_move(data, make_initial_fit(data))
    used = np.ones(len(data), dtype=bool)
    if move is not None:
        used = _longer_part(move, len(data))
        warnings.append(_move_warning(move, names, used))
    robust = fit_robust(_select(data, used), make_initial_fit(_select(data, used)))
    _check_consistency(robust, data)
    measured_scale = robust.fit.scale
    robust, wrong_scale = _settle_scale(_select(data, used), robust, refine)
    warnings += wrong_scale
    kept = used.copy()
    kept[used] = robust.kept
    # The fit of the part that is used, applied to the samples on the other side of a move as well
    whole = replace(robust.fit, board_index=np.zeros(len(data), dtype=int))
    warnings += [w for w in check_diversity(data.Ts_anchor_mount[kept]) if w.code not in {v.code for v in warnings}]
    dropped = {names[i]: "the board had been moved" for i in np.flatnonzero(~used)}
    dropped |= _outlier_reasons(data, whole, used & ~kept, names)
    if used.sum() > kept.sum():
        warnings.append(_outlier_warning(used & ~kept, names, dropped))
    return make_result(
        data,
        replace(robust, fit=whole, kept=kept),
        setup=setup,
        refine=refine,
        names=names,
        square_m=None if refine is None else refine.board.square_m * measured_scale,
        dropped=dropped,
        warnings=tuple(warnings),
    )


def _pose_data(
    Ts_base_flange: np.ndarray, Ts_camera_board: np.ndarray, setup: Setup, refine: Refinement | None
) -> PoseData:
    """Return the samples as one problem for both setups."""
    arm, boards = check_poses(Ts_base_flange, "Ts_base_flange"), check_poses(Ts_camera_board, "Ts_camera_board")
    if setup not in ("eye_in_hand", "eye_to_hand"):
        raise CalibrationError(
            f"hand-eye: unknown setup ({setup!r}, known: eye_in_hand, eye_to_hand).", code="wrong_setup"
        )
    if len(arm) != len(boards) or (refine is not None and len(refine.views) != len(arm)):
        n_views = "" if refine is None else f", {len(refine.views)} views"
        raise CalibrationError(
            f"hand-eye: the numbers of poses differ ({len(arm)} of the arm, {len(boards)} of the board{n_views}).",
            code="bad_poses",
        )
    corners = np.zeros((len(arm), 6, 6))
    if refine is not None:
        for view in refine.views:
            check_view(view, refine.board, refine.camera)
        corners = estimate_corner_covariances(refine, boards)
    return PoseData(
        Ts_anchor_mount=arm if setup == "eye_in_hand" else inverse(arm),
        Ts_camera_board=boards,
        corner_covariances=corners,
        camera_on_flange=setup == "eye_in_hand",
    )


def _check_names(names: Sequence[str] | None, n: int) -> tuple[str, ...]:
    given = tuple(str(i) for i in range(1, n + 1)) if names is None else tuple(names)
    if len(given) != n or len(set(given)) != n:
        raise CalibrationError(f"hand-eye: {n} samples need {n} different names ({given}).", code="bad_poses")
    return given


def _select(data: PoseData, used: np.ndarray) -> PoseData:
    return replace(
        data,
        Ts_anchor_mount=data.Ts_anchor_mount[used],
        Ts_camera_board=data.Ts_camera_board[used],
        corner_covariances=data.corner_covariances[used],
    )


def _longer_part(move: BoardMove, n: int) -> np.ndarray:
    before = np.arange(n) < move.first
    return before if before.sum() >= n / 2 else ~before


def _move_warning(move: BoardMove, names: tuple[str, ...], used: np.ndarray) -> CalibrationWarning:
    part = "before" if used[0] else "after"
    moved = f"the board moved by {move.mm:.1f} mm and {move.deg:.1f}° before sample {names[move.first]}"
    if used.sum() < MIN_POSES:
        raise CalibrationError(
            f"hand-eye: {moved}, and too few samples remain ({used.sum()}, needed from {MIN_POSES}). Fix the board to "
            "the table and capture them again.",
            code="board_moved",
        )
    return CalibrationWarning(
        code="board_moved",
        message=f"hand-eye: {moved}. Only the {used.sum()} samples {part} it are used; fix the board to the table.",
        samples=tuple(names[move.first :]),
    )


def _check_consistency(robust: RobustFit, data: PoseData) -> None:
    """Reject a solution with too much scatter or too many outliers, and name the likely mistake."""
    mm, deg = 1e3 * robust.noise.arm_m, np.degrees(robust.noise.arm_rad)
    dropped_ratio = 1.0 - robust.kept.mean()
    scatter_is_plausible = mm < _MAX_SCATTER_MM and deg < _MAX_SCATTER_DEG
    if scatter_is_plausible and dropped_ratio <= _MAX_DROPPED_RATIO and robust.kept.sum() >= MIN_POSES:
        return
    mistake = diagnose_pose_order(data.Ts_anchor_mount, data.Ts_camera_board)
    if mistake is not None:
        raise CalibrationError(
            f"hand-eye: the poses are inconsistent, but would be consistent if {mistake}.", code="flipped_order"
        )
    raise CalibrationError(
        f"hand-eye: no camera pose explains the samples ({(~robust.kept).sum()} of {len(robust.kept)} contradict the "
        f"others, which scatter by {mm:.1f} mm and {deg:.2f}°). Check that the board was fixed, the arm at rest "
        "at each "
        "image, all samples of one capture, and the intrinsics this camera's.",
        code="inconsistent",
    )


def _settle_scale(
    data: PoseData, robust: RobustFit, refine: Refinement | None
) -> tuple[RobustFit, list[CalibrationWarning]]:
    """Return the fit with squares of the given size, or of the measured size when the samples contradict it."""
    C = compute_covariances(data, robust.fit, robust.noise)
    _, P = solve_least_squares(data, robust.fit, C, robust.kept.astype(float), free_scale=True, rounds=1)
    difference, sd = robust.fit.scale - 1.0, float(np.sqrt(P[0, 0]))
    # Four standard deviations are exceeded by chance once in 16,000 calibrations
    if abs(difference) <= WRONG_SCALE or abs(difference) < 4.0 * sd:
        return fit_robust(data, replace(robust.fit, scale=1.0), free_scale=False), []
    if refine is None:
        finding = f"it is {100 * abs(difference):.1f} % {'larger' if difference > 0 else 'smaller'} than by its poses"
    else:
        given = 1e3 * refine.board.square_m
        finding = f"its squares measure {given * robust.fit.scale:.2f} mm (± {given * 3 * sd:.2f}), not {given:.2f} mm"
    message = (
        f"board: by the arm's motions {finding}. The measured size was used; measure the print and solve again with "
        "the right one. If the print is right, calibrate the intrinsics."
    )
    return robust, [CalibrationWarning(code="wrong_square_size", message=message)]


def _outlier_reasons(data: PoseData, fit: PoseFit, outliers: np.ndarray, names: tuple[str, ...]) -> dict[str, str]:
    mm, deg = lengths_mm_deg(compute_residuals(data, fit))
    return {
        names[i]: f"its board is {mm[i]:.1f} mm and {deg[i]:.2f}° from that of the others"
        for i in np.flatnonzero(outliers)
    }


def _outlier_warning(outliers: np.ndarray, names: tuple[str, ...], dropped: dict[str, str]) -> CalibrationWarning:
    found = tuple(names[i] for i in np.flatnonzero(outliers))
    reasons = "; ".join(f"{name}: {dropped[name]}" for name in found)
    message = (
        f"samples: {len(found)} contradict the others and were dropped ({reasons}). Check that the arm was at rest and "
        "the board unobstructed."
    )
    return CalibrationWarning(code="outliers", message=message, samples=found)
