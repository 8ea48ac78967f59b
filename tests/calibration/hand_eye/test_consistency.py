"""Consistency: outliers, moves of the board, and mistakes in the order of the poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calibration.hand_eye.consistency import (
    detect_board_move,
    diagnose_pose_order,
    fit_robust,
    make_initial_fit,
    solve_reweighted,
)
from calibration.hand_eye.pose_fit import NoiseLevels, PoseData
from calibration.pose_checks import pose_distances_mm_deg
from hal.base.transforms import apply_increment, inverse
from tests.support.calibration_data import T_FLANGE_CAMERA
from tests.support.hand_eye_problems import make_problem


def noisy_problem(seed: int, n: int = 20) -> PoseData:
    return make_problem(seed, n, arm_m=1e-4, arm_rad=2e-4)


def move_arm(data: PoseData, samples: list[int], increment: list[float]) -> PoseData:
    arm = data.Ts_anchor_mount.copy()
    arm[samples] = apply_increment(arm[samples], np.tile(increment, (len(samples), 1)))
    return replace(data, Ts_anchor_mount=arm)


@pytest.mark.parametrize("outliers", [[], [3], [0, 7, 19]])
def test_robust_fit_drops_the_outliers_and_no_inliers(outliers: list[int]) -> None:
    data = move_arm(noisy_problem(0), outliers, [0.01, -0.005, 0.0, 0.0, 0.03, 0.0])
    robust = fit_robust(data, make_initial_fit(data))
    assert np.flatnonzero(~robust.kept).tolist() == outliers
    mm, deg = pose_distances_mm_deg(robust.fit.T_mount_camera, T_FLANGE_CAMERA)
    assert mm < 0.5
    assert deg < 0.1
    assert robust.noise.arm_m == pytest.approx(1e-4, rel=0.5)


def test_outlier_has_no_influence_on_the_reweighted_fit() -> None:
    data = noisy_problem(1)
    clean, _ = solve_reweighted(data, make_initial_fit(data), NoiseLevels())
    bad = move_arm(data, [4], [0.1, 0.0, 0.0, 0.0, 0.2, 0.0])
    found, d2 = solve_reweighted(bad, make_initial_fit(bad), NoiseLevels())
    assert d2.argmax() == 4
    assert d2[4] > 100.0 * np.median(d2)
    # What remains is the sample's own contribution to the clean fit
    assert pose_distances_mm_deg(found.T_mount_camera, clean.T_mount_camera)[0] < 0.2


def test_fixed_scale_is_kept() -> None:
    data = noisy_problem(2)
    fit = replace(make_initial_fit(data), scale=1.0)
    assert fit_robust(data, fit, free_scale=False).fit.scale == 1.0
    assert fit_robust(data, fit).fit.scale != 1.0


@pytest.mark.integration
@pytest.mark.parametrize("first", [5, 12])
def test_move_of_the_board_is_located_and_measured(first: int) -> None:
    data = noisy_problem(3)
    T_move = apply_increment(np.eye(4), np.array([0.006, 0.0, 0.0, 0.0, 0.0, 0.02]))
    boards = data.Ts_camera_board.copy()
    boards[first:] = boards[first:] @ T_move
    moved = replace(data, Ts_camera_board=boards)
    move = detect_board_move(moved, make_initial_fit(moved))
    assert move is not None
    assert move.first == first
    assert move.mm == pytest.approx(6.0, abs=0.3)
    assert move.deg == pytest.approx(np.degrees(0.02), abs=0.1)


@pytest.mark.integration
def test_fixed_board_has_no_move_even_with_an_outlier() -> None:
    for data in (noisy_problem(4), move_arm(noisy_problem(4), [9], [0.02, 0.0, 0.0, 0.0, 0.0, 0.0])):
        assert detect_board_move(data, make_initial_fit(data)) is None


MISTAKES: dict[str, Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
    "arm's": lambda A, B: (inverse(A), B),
    "board's": lambda A, B: (A, inverse(B)),
    "reversed": lambda A, B: (A[::-1], B),
    "next pose": lambda A, B: (A[:-1], B[1:]),
    "previous pose": lambda A, B: (A[1:], B[:-1]),
}


@pytest.mark.integration
@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_in_the_order_are_diagnosed(mistake: str) -> None:
    data = noisy_problem(5, 12)
    diagnosis = diagnose_pose_order(*MISTAKES[mistake](data.Ts_anchor_mount, data.Ts_camera_board))
    assert diagnosis is not None
    # Inverted arm poses are explained by inverted board poses as well, and the reverse
    assert ("poses are inverted" if mistake in ("arm's", "board's") else mistake) in diagnosis


@pytest.mark.integration
def test_correct_and_unrelated_poses_have_no_diagnosis() -> None:
    one, other = noisy_problem(6, 12), noisy_problem(7, 12)
    assert diagnose_pose_order(one.Ts_anchor_mount, one.Ts_camera_board) is None
    assert diagnose_pose_order(one.Ts_anchor_mount, other.Ts_camera_board) is None
