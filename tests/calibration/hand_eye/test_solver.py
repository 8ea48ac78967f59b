"""Hand-eye solver: error against the ground truth, stated uncertainty, and each kind of bad samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.errors import CalibrationError
from calibration.hand_eye.solver import HandEyeResult, Refinement, solve_hand_eye
from calibration.pose_checks import pose_distances_mm_deg
from hal.base.transforms import apply_increment, inverse
from tests.support.calibration_data import (
    BOARD,
    CAMERA,
    T_BASE_BOARD,
    T_FLANGE_CAMERA,
    Recording,
    corrupt,
    record,
    sample_T_camera_board,
)
from tests.support.errors import raises


def solved(recording: Recording, *, refine: bool = True) -> HandEyeResult:
    return solve_hand_eye(
        recording.Ts_base_flange, recording.Ts_camera_board, refine=recording.refine if refine else None
    )


def codes(result: HandEyeResult) -> set[str]:
    return {warning.code for warning in result.warnings}


def assert_covered(result: HandEyeResult) -> None:
    mm, deg = pose_distances_mm_deg(result.T_flange_camera, T_FLANGE_CAMERA)
    assert mm <= result.uncertainty_mm
    assert deg <= result.uncertainty_deg


@pytest.fixture(scope="module")
def good() -> HandEyeResult:
    return solved(record(0))


@pytest.mark.integration
def test_twenty_poses_find_the_camera_to_half_a_millimetre_and_a_tenth_of_a_degree(good: HandEyeResult) -> None:
    mm, deg = pose_distances_mm_deg(good.T_flange_camera, T_FLANGE_CAMERA)
    assert mm <= 0.5
    assert deg <= 0.1
    assert_covered(good)
    assert pose_distances_mm_deg(good.T_base_board, T_BASE_BOARD)[0] <= 1.0
    assert good.warnings == ()
    assert good.dropped == {}


def test_all_seven_methods_are_reported_and_agree(good: HandEyeResult) -> None:
    assert {m.name for m in good.methods} == {"tsai", "park", "horaud", "andreff", "daniilidis", "shah", "li"}
    for method in good.methods:
        mm, deg = pose_distances_mm_deg(method.T_mount_camera, T_FLANGE_CAMERA)
        assert mm < 3.0, method.name
        assert deg < 0.5, method.name


def test_the_refinement_lowers_the_reprojection_error(good: HandEyeResult) -> None:
    assert good.initial_px is not None
    assert good.residuals_px is not None
    assert np.sqrt(np.mean(good.residuals_px**2)) < np.sqrt(np.mean(good.initial_px**2))


def test_scatter_of_the_arm_is_estimated(good: HandEyeResult) -> None:
    assert 0.5e-4 < good.noise.arm_m < 2e-4
    assert 0.005 < np.degrees(good.noise.arm_rad) < 0.02


def test_the_hold_out_error_is_larger_than_the_residual(good: HandEyeResult) -> None:
    assert good.rms_mm < good.holdout_mm < 2.0 * good.rms_mm


@pytest.mark.integration
@pytest.mark.parametrize("arm", [0.0, 5.0])
def test_uncertainty_follows_the_scatter_of_the_arm_and_covers_the_error(arm: float, good: HandEyeResult) -> None:
    result = solved(record(1, arm_m=arm * 1e-4, arm_deg=arm * 0.01))
    assert_covered(result)
    assert (result.uncertainty_mm > good.uncertainty_mm) == (arm > 1.0)


@pytest.mark.slow
def test_the_uncertainty_covers_the_true_error_in_at_least_18_of_20_sessions() -> None:
    covered = 0
    for seed in range(20):
        result = solved(record(seed))
        mm, deg = pose_distances_mm_deg(result.T_flange_camera, T_FLANGE_CAMERA)
        assert mm <= 0.5
        assert deg <= 0.1
        covered += mm <= result.uncertainty_mm and deg <= result.uncertainty_deg
    assert covered >= 18


@pytest.mark.integration
def test_two_outliers_of_twenty_are_named_and_dropped() -> None:
    recording = corrupt(record(2), 4, np.array([0.004, 0.0, 0.003, 0.0, 0.0, 0.01]))
    recording = corrupt(recording, 17, np.array([0.0, -0.02, 0.0, 0.03, 0.0, 0.0]))
    result = solved(recording)
    assert set(result.dropped) == {"5", "18"}
    assert "mm" in result.dropped["5"]
    (warning,) = result.warnings
    assert warning.code == "outliers"
    assert warning.samples == ("5", "18")
    assert_covered(result)
    assert pose_distances_mm_deg(result.T_flange_camera, T_FLANGE_CAMERA)[0] <= 0.5


@pytest.mark.integration
def test_a_few_wrong_corners_do_no_harm() -> None:
    recording = record(3)
    for view in recording.views[::4]:
        view.pixels_px[::9] += 3.0
    result = solved(recording)
    assert pose_distances_mm_deg(result.T_flange_camera, T_FLANGE_CAMERA)[0] <= 0.5


@pytest.mark.integration
def test_without_refinement_the_poses_alone_do() -> None:
    result = solved(record(0), refine=False)
    assert result.rms_px is None
    assert pose_distances_mm_deg(result.T_flange_camera, T_FLANGE_CAMERA)[0] <= 1.0


@pytest.mark.integration
def test_eye_to_hand_camera_is_found() -> None:
    recording = record(4)
    # The same samples with the roles of base and flange exchanged
    result = solve_hand_eye(
        inverse(recording.Ts_base_flange), recording.Ts_camera_board, setup="eye_to_hand", refine=recording.refine
    )
    mm, deg = pose_distances_mm_deg(result.T_base_camera, T_FLANGE_CAMERA)
    assert mm <= 0.5
    assert deg <= 0.1
    assert pose_distances_mm_deg(result.T_flange_board, T_BASE_BOARD)[0] <= 1.0
    with raises(CalibrationError, "wrong_setup"):
        _ = result.T_flange_camera


@pytest.mark.integration
def test_another_base_frame_changes_nothing_of_the_camera(good: HandEyeResult) -> None:
    recording = record(0)
    T_other_base = apply_increment(np.eye(4), np.array([0.5, -1.0, 0.2, 0.4, -0.7, 2.0]))
    result = solve_hand_eye(T_other_base @ recording.Ts_base_flange, recording.Ts_camera_board, refine=recording.refine)
    np.testing.assert_allclose(result.T_flange_camera, good.T_flange_camera, atol=2e-5)
    np.testing.assert_allclose(result.T_base_board, T_other_base @ good.T_base_board, atol=5e-5)
    assert result.uncertainty_mm == pytest.approx(good.uncertainty_mm, rel=0.05)


@pytest.mark.integration
def test_another_flange_frame_moves_the_camera_by_it(good: HandEyeResult) -> None:
    recording = record(0)
    T_other_flange = apply_increment(np.eye(4), np.array([0.0, 0.0, 0.0, 0.3, -0.2, 1.0]))
    result = solve_hand_eye(
        recording.Ts_base_flange @ T_other_flange, recording.Ts_camera_board, refine=recording.refine
    )
    np.testing.assert_allclose(T_other_flange @ result.T_flange_camera, good.T_flange_camera, atol=5e-5)


@pytest.mark.integration
def test_few_poses_give_a_warning_and_very_few_are_rejected() -> None:
    recording = record(5, 7)
    assert "too_few_poses" in codes(solved(recording))
    with raises(CalibrationError, "too_few_poses"):
        solve_hand_eye(recording.Ts_base_flange[:4], recording.Ts_camera_board[:4])


def record_rotations(turns: np.ndarray) -> Recording:
    """Return a capture with the camera rotated by these vectors (N, 3) [°] in front of the board."""
    rng = np.random.default_rng(7)
    Ts = np.repeat(sample_T_camera_board(rng, tilt_deg=0.0)[None], len(turns), axis=0)
    middle = Ts[0] @ np.array([*(0.5 * np.array(BOARD.size_m)), 0.0, 1.0])
    for T, turn in zip(Ts, Rotation.from_rotvec(turns, degrees=True).as_matrix(), strict=True):
        T[:3, :3] = turn @ T[:3, :3]
        T[:3, 3] = middle[:3] - T[:3, :3] @ (*(0.5 * np.array(BOARD.size_m)), 0.0) + rng.uniform(-0.02, 0.02, 3)
    return record(7, len(turns), Ts_camera_board=Ts)


def test_similar_poses_are_rejected() -> None:
    recording = record_rotations(np.random.default_rng(1).uniform(-1.0, 1.0, (12, 3)))
    with raises(CalibrationError, "too_similar_poses"):
        solved(recording)


@pytest.mark.integration
def test_rather_similar_poses_give_a_warning() -> None:
    recording = record_rotations(np.random.default_rng(1).uniform(-6.0, 6.0, (12, 3)))
    assert "too_similar_poses" in codes(solved(recording))


def test_rotations_about_one_axis_are_rejected() -> None:
    turns = np.outer(np.linspace(-40.0, 40.0, 12), [0.0, 0.0, 1.0])
    with raises(CalibrationError, "planar_rotations"):
        solved(record_rotations(turns))


@pytest.mark.integration
def test_weak_second_axis_gives_a_warning() -> None:
    turns = np.outer(np.linspace(-40.0, 40.0, 12), [0.0, 0.0, 1.0]) + 3.0 * np.array([[1, 0, 0], [-1, 0, 0]] * 6)
    result = solved(record_rotations(turns))
    assert "planar_rotations" in codes(result)
    assert result.diversity < 0.9


@pytest.mark.integration
@pytest.mark.parametrize("scale", [0.99, 1.04])
def test_wrong_square_size_is_measured(scale: float) -> None:
    result = solved(record(8, scale=scale))
    (warning,) = [w for w in result.warnings if w.code == "wrong_square_size"]
    assert "not 25.00 mm" in warning.message
    assert result.square_m == pytest.approx(scale * BOARD.square_m, rel=2e-3)
    assert pose_distances_mm_deg(result.T_flange_camera, T_FLANGE_CAMERA)[0] <= 1.0


@pytest.mark.integration
def test_print_wrong_by_a_thousandth_gives_no_warning() -> None:
    assert "wrong_square_size" not in codes(solved(record(8, scale=1.001)))


@pytest.mark.integration
def test_moved_board_is_reported_with_sample_and_distance() -> None:
    moves = np.repeat(T_BASE_BOARD[None], 20, axis=0)
    moves[13:] = apply_increment(T_BASE_BOARD, np.array([0.005, 0.0, 0.0, 0.0, 0.0, 0.0]))
    result = solved(record(9, T_base_boards=moves))
    (warning,) = [w for w in result.warnings if w.code == "board_moved"]
    assert warning.samples == tuple(str(i) for i in range(14, 21))
    assert float(warning.message.split("moved by ")[1].split(" mm")[0]) == pytest.approx(5.0, abs=0.7)
    assert set(result.dropped) == set(warning.samples)
    assert_covered(result)


@pytest.mark.integration
def test_a_board_that_moved_early_leaves_the_samples_after_it() -> None:
    moves = np.repeat(T_BASE_BOARD[None], 20, axis=0)
    moves[6:] = apply_increment(T_BASE_BOARD, np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.1]))
    result = solved(record(10, T_base_boards=moves))
    assert set(result.dropped) == {str(i) for i in range(1, 7)}
    assert_covered(result)


def test_too_few_samples_after_a_move_are_rejected() -> None:
    moves = np.repeat(T_BASE_BOARD[None], 8, axis=0)
    moves[4:] = apply_increment(T_BASE_BOARD, np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0]))
    with raises(CalibrationError, "board_moved"):
        solved(record(11, 8, T_base_boards=moves))


@pytest.mark.integration
@pytest.mark.parametrize(
    "mistake",
    [
        lambda r: (inverse(r.Ts_base_flange), r.Ts_camera_board),
        lambda r: (r.Ts_base_flange[:-1], r.Ts_camera_board[1:]),
    ],
    ids=["arm inverted", "next"],  # test_consistency.py has all mistakes
)
def test_poses_in_a_wrong_order_are_diagnosed(mistake) -> None:
    with raises(CalibrationError, "flipped_order"):
        solve_hand_eye(*mistake(record(12, 12)))


@pytest.mark.integration
def test_unrelated_samples_are_rejected() -> None:
    one, other = record(13, 12), record(14, 12)
    with raises(CalibrationError, "inconsistent"):
        solve_hand_eye(one.Ts_base_flange, other.Ts_camera_board)


def test_invalid_poses_and_missing_views_are_rejected() -> None:
    recording = record(15, 6)
    broken = recording.Ts_base_flange.copy()
    broken[2, :3, :3] *= 1.1
    with raises(CalibrationError, "bad_poses"):
        solve_hand_eye(broken, recording.Ts_camera_board)
    with raises(CalibrationError, "bad_poses"):
        solve_hand_eye(recording.Ts_base_flange[:5], recording.Ts_camera_board)
    with raises(CalibrationError, "bad_poses"):
        solve_hand_eye(
            recording.Ts_base_flange,
            recording.Ts_camera_board,
            refine=Refinement(board=BOARD, camera=CAMERA, views=recording.views[:5]),
        )
    with raises(CalibrationError, "bad_poses"):
        solve_hand_eye(recording.Ts_base_flange, recording.Ts_camera_board, names=["a"] * 6)


def test_view_of_another_camera_is_rejected() -> None:
    recording = record(16, 6)
    views = [replace(view, image_size=(1280, 720)) for view in recording.views]
    with raises(CalibrationError, "bad_view"):
        solve_hand_eye(
            recording.Ts_base_flange,
            recording.Ts_camera_board,
            refine=Refinement(board=BOARD, camera=CAMERA, views=views),
        )
