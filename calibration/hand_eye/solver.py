"""Where the camera sits: on the arm's flange (eye in hand) or beside the arm (eye to hand).

Both are one problem. Call *mount* what carries the camera and *anchor* what carries the board: flange and base for an
eye in hand, base and flange for an eye to hand. Then for every sample
    T_anchor_mount · T_mount_camera · T_camera_board = T_anchor_board
with T_mount_camera and T_anchor_board unknown and constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.board.pose import check_view
from calibration.errors import CalibrationError, CalibrationWarning
from calibration.hand_eye.closed_forms import all_closed_forms
from calibration.hand_eye.consistency import Belief, Move, believe, explain_order, find_move, start_fit
from calibration.hand_eye.diversity import MIN_POSES, check_diversity, diversity
from calibration.hand_eye.pose_fit import PoseData, PoseFit, covariances, errors, leave_one_out, predict, solve
from calibration.hand_eye.refinement import Refinement, corner_covariances, refine_jointly, reprojection_px
from calibration.hand_eye.result import HandEyeResult, MethodResult, Setup
from calibration.hand_eye.uncertainty import radius
from calibration.transforms import check_poses, inverse

WRONG_SCALE = 0.005
"""Squares that measure this share more or less than the settings say get the warning `wrong_square_size`."""

_WORST_MM, _WORST_DEG = 10.0, 2.0  # an arm and a camera that scatter more are not calibrated but mistaken
_MAX_DROPPED = 0.4  # share of samples that may be bad


def solve_hand_eye(
    Ts_base_flange: np.ndarray,
    Ts_camera_board: np.ndarray,
    *,
    setup: Setup = "eye_in_hand",
    refine: Refinement | None = None,
    names: Sequence[str] | None = None,
) -> HandEyeResult:
    """Return the camera's pose from N samples in the order they were taken.

    Args:
        Ts_base_flange: (N, 4, 4) the arm's pose at each sample, by its own kinematics.
        Ts_camera_board: (N, 4, 4) the board's pose seen in each, by `estimate_board_pose`.
        setup: whether the arm carries the camera or the board.
        refine: refine camera and board pose together by the reprojection error; weights and uncertainty are then
            those of the corners and of the arm's own scatter, which is estimated from the samples.
        names: of the samples, for messages ("1", "2", … when None).

    Raises:
        CalibrationError: `too_few_poses`, `too_similar_poses`, `planar_rotations`, `flipped_order` (poses inverted or
            in another order), `inconsistent` (nothing explains the samples), `bad_poses` (shapes, not rigid).
    """
    data = _pose_data(Ts_base_flange, Ts_camera_board, setup, refine)
    names = _names(names, len(data))
    warnings = check_diversity(data.Ts_anchor_mount)
    fit = start_fit(data)
    move = find_move(data, fit)
    used = np.ones(len(data), dtype=bool)
    if move is not None:
        used = _longer_part(move, len(data))
        warnings.append(_moved(move, names, used))
    belief = believe(_part(data, used), start_fit(_part(data, used)))
    _check_belief(belief, data)
    seen_scale = belief.fit.scale
    belief, wrong_scale = _settle_scale(_part(data, used), belief, refine)
    warnings += wrong_scale
    kept = used.copy()
    kept[used] = belief.kept
    whole = replace(belief.fit, place=np.zeros(len(data), dtype=int))  # the samples before or after a move as well
    warnings += [w for w in check_diversity(data.Ts_anchor_mount[kept]) if w.code not in {v.code for v in warnings}]
    dropped = {names[i]: "the board had been moved" for i in np.flatnonzero(~used)}
    dropped |= _outliers(data, whole, used & ~kept, names)
    if used.sum() > kept.sum():
        warnings.append(_outlier_warning(used & ~kept, names, dropped))
    return _result(
        data,
        replace(belief, fit=whole, kept=kept),
        setup=setup,
        refine=refine,
        names=names,
        square_m=None if refine is None else refine.board.square_m * seen_scale,
        dropped=dropped,
        warnings=tuple(warnings),
    )


def _pose_data(
    Ts_base_flange: np.ndarray, Ts_camera_board: np.ndarray, setup: Setup, refine: Refinement | None
) -> PoseData:
    """Return the samples as one problem, whichever setup they are of."""
    arm, seen = check_poses(Ts_base_flange, "Ts_base_flange"), check_poses(Ts_camera_board, "Ts_camera_board")
    if setup not in ("eye_in_hand", "eye_to_hand"):
        raise CalibrationError("wrong_setup", f"there is no setup {setup!r}; known: eye_in_hand, eye_to_hand.")
    if len(arm) != len(seen) or (refine is not None and len(refine.views) != len(arm)):
        n_views = "" if refine is None else f" and {len(refine.views)} views"
        raise CalibrationError(
            "bad_poses", f"{len(arm)} arm poses, {len(seen)} board poses{n_views}: one each is needed."
        )
    corners = np.zeros((len(arm), 6, 6))
    if refine is not None:
        for view in refine.views:
            check_view(view, refine.board, refine.camera)
        corners = corner_covariances(refine, seen)
    return PoseData(
        Ts_anchor_mount=arm if setup == "eye_in_hand" else inverse(arm),
        Ts_camera_board=seen,
        corner_covariances=corners,
        camera_on_flange=setup == "eye_in_hand",
    )


def _names(names: Sequence[str] | None, n: int) -> tuple[str, ...]:
    given = tuple(str(i) for i in range(1, n + 1)) if names is None else tuple(names)
    if len(given) != n or len(set(given)) != n:
        raise CalibrationError("bad_poses", f"{n} samples need as many different names; got {given}.")
    return given


def _part(data: PoseData, used: np.ndarray) -> PoseData:
    return replace(
        data,
        Ts_anchor_mount=data.Ts_anchor_mount[used],
        Ts_camera_board=data.Ts_camera_board[used],
        corner_covariances=data.corner_covariances[used],
    )


def _longer_part(move: Move, n: int) -> np.ndarray:
    before = np.arange(n) < move.first
    return before if before.sum() >= n / 2 else ~before


def _moved(move: Move, names: tuple[str, ...], used: np.ndarray) -> CalibrationWarning:
    part = "before" if used[0] else "after"
    if used.sum() < MIN_POSES:
        raise CalibrationError(
            "board_moved",
            f"from sample {names[move.first]} on the board lies {move.mm:.1f} mm and {move.deg:.1f}° elsewhere, and "
            "too few samples remain: fix the board to the table and take them again.",
        )
    return CalibrationWarning(
        code="board_moved",
        message=f"samples {names[move.first]} to {names[-1]} see the board {move.mm:.1f} mm and {move.deg:.1f}° away "
        f"from where the earlier ones do: it was moved. Only the {used.sum()} samples {part} that are used; "
        "fix the board.",
        samples=tuple(names[move.first :]),
    )


def _check_belief(belief: Belief, data: PoseData) -> None:
    """Refuse a solution that does not hold together, and tell the likely mistake."""
    mm, deg = 1e3 * belief.noise.arm_m, np.degrees(belief.noise.arm_rad)
    share = 1.0 - belief.kept.mean()
    if mm < _WORST_MM and deg < _WORST_DEG and share <= _MAX_DROPPED and belief.kept.sum() >= MIN_POSES:
        return
    mistake = explain_order(data.Ts_anchor_mount, data.Ts_camera_board)
    if mistake is not None:
        raise CalibrationError("flipped_order", f"these poses do not fit together, but would if {mistake}.")
    raise CalibrationError(
        "inconsistent",
        f"no camera pose explains these samples: {(~belief.kept).sum()} of {len(belief.kept)} contradict the others, "
        f"which scatter by {mm:.1f} mm and {deg:.2f}°. Was the board fixed, did the arm rest at each picture, are the "
        "samples of one session and the intrinsics this camera's?",
    )


def _settle_scale(data: PoseData, belief: Belief, refine: Refinement | None) -> tuple[Belief, list[CalibrationWarning]]:
    """Return the belief with squares of the size given, or, when the samples contradict it, of the size they show."""
    C = covariances(data, belief.fit, belief.noise)
    _, P = solve(data, belief.fit, C, belief.kept.astype(float), free_scale=True, rounds=1)
    off, sd = belief.fit.scale - 1.0, float(np.sqrt(P[0, 0]))
    if abs(off) <= WRONG_SCALE or abs(off) < 4.0 * sd:
        return believe(data, replace(belief.fit, scale=1.0), free_scale=False), []
    if refine is None:
        what = f"the board is {100 * abs(off):.1f} % {'larger' if off > 0 else 'smaller'} than its poses say"
    else:
        given = 1e3 * refine.board.square_m
        what = f"the squares measure {given * belief.fit.scale:.2f} mm (± {given * 3 * sd:.2f}), not {given:.2f} mm"
    message = (
        f"{what}, as the arm's motions show. That size was used; measure the print and solve again with the right one. "
        "If the print is right, calibrate the intrinsics."
    )
    return belief, [CalibrationWarning(code="wrong_square_size", message=message)]


def _outliers(data: PoseData, fit: PoseFit, bad: np.ndarray, names: tuple[str, ...]) -> dict[str, str]:
    mm, deg = _sizes(errors(data, fit))
    return {
        names[i]: f"sees the board {mm[i]:.1f} mm and {deg[i]:.2f}° from where the others do"
        for i in np.flatnonzero(bad)
    }


def _outlier_warning(bad: np.ndarray, names: tuple[str, ...], dropped: dict[str, str]) -> CalibrationWarning:
    found = tuple(names[i] for i in np.flatnonzero(bad))
    told = "; ".join(f"{name} {dropped[name]}" for name in found)
    message = (
        f"{len(found)} samples contradict the others and were dropped: {told}. Did the arm rest, was the board clear?"
    )
    return CalibrationWarning(code="outliers", message=message, samples=found)


def _sizes(e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lengths [mm] and angles [°] of errors (N, 6)."""
    return 1e3 * np.linalg.norm(e[:, :3], axis=1), np.degrees(np.linalg.norm(e[:, 3:], axis=1))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _methods(data: PoseData, kept: np.ndarray, scale: float) -> tuple[MethodResult, ...]:
    """Return what the closed forms make of the samples kept, the best first."""
    seen = data.Ts_camera_board[kept].copy()
    seen[:, :3, 3] *= scale
    arm, found = data.Ts_anchor_mount[kept], []
    for name, T_mount_camera in all_closed_forms(arm, seen):
        T_anchor_board = _mean_pose(arm @ T_mount_camera @ seen)
        fit = PoseFit(
            T_mount_camera=T_mount_camera, Ts_anchor_board=T_anchor_board[None], place=np.zeros(len(data), int)
        )
        mm, deg = _sizes(errors(data, replace(fit, scale=scale))[kept])
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
    U, _, Vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = U @ Vt
    return T


def _result(
    data: PoseData,
    belief: Belief,
    *,
    setup: Setup,
    refine: Refinement | None,
    names: tuple[str, ...],
    square_m: float | None,
    dropped: dict[str, str],
    warnings: tuple[CalibrationWarning, ...],
) -> HandEyeResult:
    """Refine, and judge what came of it."""
    fit, kept = belief.fit, belief.kept
    methods = _methods(data, kept, fit.scale)
    C = covariances(data, fit, belief.noise)
    initial_px = px = None
    if refine is None:
        fit, P = solve(data, fit, C, kept.astype(float), free_scale=False)
        covariance = P[1:7, 1:7]
    else:
        if methods:
            best = replace(
                fit, T_mount_camera=methods[0].T_mount_camera, Ts_anchor_board=methods[0].T_anchor_board[None]
            )
            initial_px = reprojection_px(refine, predict(data, best), fit.scale)
        fit, covariance = refine_jointly(refine, data, fit, belief.noise, kept)
        px = reprojection_px(refine, predict(data, fit), fit.scale)
    mm, deg = _sizes(errors(data, fit))
    out_mm, out_deg = _sizes(leave_one_out(data, fit, C, kept, free_scale=False)[0][kept])
    corners = None if refine is None else np.array([len(view.ids) for view in refine.views])[kept]
    return HandEyeResult(
        setup=setup,
        T_mount_camera=fit.T_mount_camera,
        T_anchor_board=fit.Ts_anchor_board[0],
        covariance=covariance,
        uncertainty_mm=1e3 * radius(covariance[:3, :3], int(kept.sum())),
        uncertainty_deg=float(np.degrees(radius(covariance[3:, 3:], int(kept.sum())))),
        methods=methods,
        sample_names=names,
        residuals_mm=mm,
        residuals_deg=deg,
        residuals_px=px,
        initial_px=initial_px,
        rms_mm=_rms(mm[kept]),
        rms_deg=_rms(deg[kept]),
        rms_px=None if px is None or corners is None else float(np.sqrt(np.average(px[kept] ** 2, weights=corners))),
        holdout_mm=_rms(out_mm),
        holdout_deg=_rms(out_deg),
        diversity=diversity(data.Ts_anchor_mount[kept]),
        square_m=square_m,
        noise=belief.noise,
        dropped=dropped,
        warnings=warnings,
    )
