"""Hand-eye: against a known truth, its honesty about the error, and each way a session goes wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.errors import CalibrationError
from calibration.hand_eye.solver import HandEyeResult, Refinement, solve_hand_eye
from calibration.transforms import distance, inverse, moved
from tests.support.calibration_data import (
    BOARD,
    CAMERA,
    T_BASE_BOARD,
    T_FLANGE_CAMERA,
    Recording,
    corrupt,
    look_at_board,
    record,
)


def solved(recording: Recording, *, refine: bool = True) -> HandEyeResult:
    return solve_hand_eye(
        recording.Ts_base_flange, recording.Ts_camera_board, refine=recording.refine if refine else None
    )


def codes(result: HandEyeResult) -> set[str]:
    return {warning.code for warning in result.warnings}


def assert_covered(result: HandEyeResult) -> None:
    mm, deg = distance(result.T_flange_camera, T_FLANGE_CAMERA)
    assert mm <= result.uncertainty_mm
    assert deg <= result.uncertainty_deg


@pytest.fixture(scope="module")
def good() -> HandEyeResult:
    return solved(record(0))


def test_twenty_poses_find_the_camera_to_half_a_millimetre_and_a_tenth_of_a_degree(good: HandEyeResult) -> None:
    mm, deg = distance(good.T_flange_camera, T_FLANGE_CAMERA)
    assert mm <= 0.5
    assert deg <= 0.1
    assert_covered(good)
    assert distance(good.T_base_board, T_BASE_BOARD)[0] <= 1.0
    assert good.warnings == ()
    assert good.dropped == {}


def test_all_seven_methods_are_told_and_near_each_other(good: HandEyeResult) -> None:
    assert {m.name for m in good.methods} == {"tsai", "park", "horaud", "andreff", "daniilidis", "shah", "li"}
    for method in good.methods:
        mm, deg = distance(method.T_mount_camera, T_FLANGE_CAMERA)
        assert mm < 3.0, method.name
        assert deg < 0.5, method.name


def test_the_refinement_lowers_the_reprojection_error(good: HandEyeResult) -> None:
    assert good.initial_px is not None
    assert good.residuals_px is not None
    assert np.sqrt(np.mean(good.residuals_px**2)) < np.sqrt(np.mean(good.initial_px**2))


def test_the_scatter_of_the_arm_is_seen(good: HandEyeResult) -> None:
    assert 0.5e-4 < good.noise.arm_m < 2e-4
    assert 0.005 < np.degrees(good.noise.arm_rad) < 0.02


def test_the_hold_out_error_is_larger_than_the_residual(good: HandEyeResult) -> None:
    assert good.rms_mm < good.holdout_mm < 2.0 * good.rms_mm


@pytest.mark.parametrize("arm", [0.0, 5.0])
def test_a_steadier_or_shakier_arm_changes_the_uncertainty_and_not_the_honesty(arm: float, good: HandEyeResult) -> None:
    result = solved(record(1, arm_m=arm * 1e-4, arm_deg=arm * 0.01))
    assert_covered(result)
    assert (result.uncertainty_mm > good.uncertainty_mm) == (arm > 1.0)


@pytest.mark.slow
def test_the_uncertainty_covers_the_true_error_in_at_least_18_of_20_sessions() -> None:
    covered = 0
    for seed in range(20):
        result = solved(record(seed))
        mm, deg = distance(result.T_flange_camera, T_FLANGE_CAMERA)
        assert mm <= 0.5
        assert deg <= 0.1
        covered += mm <= result.uncertainty_mm and deg <= result.uncertainty_deg
    assert covered >= 18


def test_two_bad_samples_of_twenty_are_found_named_and_dropped() -> None:
    recording = corrupt(record(2), 4, np.array([0.004, 0.0, 0.003, 0.0, 0.0, 0.01]))
    recording = corrupt(recording, 17, np.array([0.0, -0.02, 0.0, 0.03, 0.0, 0.0]))
    result = solved(recording)
    assert set(result.dropped) == {"5", "18"}
    assert "mm" in result.dropped["5"]
    (warning,) = result.warnings
    assert warning.code == "outliers"
    assert warning.samples == ("5", "18")
    assert_covered(result)
    assert distance(result.T_flange_camera, T_FLANGE_CAMERA)[0] <= 0.5


def test_a_few_wrong_corners_do_no_harm() -> None:
    recording = record(3)
    for view in recording.views[::4]:
        view.pixels_px[::9] += 3.0
    result = solved(recording)
    assert distance(result.T_flange_camera, T_FLANGE_CAMERA)[0] <= 0.5


def test_without_refinement_the_poses_alone_do() -> None:
    result = solved(record(0), refine=False)
    assert result.rms_px is None
    assert distance(result.T_flange_camera, T_FLANGE_CAMERA)[0] <= 1.0


def test_a_camera_beside_the_arm_is_found_too() -> None:
    hand = record(4)
    # the same numbers read the other way round: what was the flange stands still, what was the base moves
    result = solve_hand_eye(inverse(hand.Ts_base_flange), hand.Ts_camera_board, setup="eye_to_hand", refine=hand.refine)
    mm, deg = distance(result.T_base_camera, T_FLANGE_CAMERA)
    assert mm <= 0.5
    assert deg <= 0.1
    assert distance(result.T_flange_board, T_BASE_BOARD)[0] <= 1.0
    with pytest.raises(CalibrationError, match="eye_to_hand"):
        _ = result.T_flange_camera


def test_another_base_frame_changes_nothing_of_the_camera(good: HandEyeResult) -> None:
    recording = record(0)
    T_other_base = moved(np.eye(4), np.array([0.5, -1.0, 0.2, 0.4, -0.7, 2.0]))
    result = solve_hand_eye(T_other_base @ recording.Ts_base_flange, recording.Ts_camera_board, refine=recording.refine)
    np.testing.assert_allclose(result.T_flange_camera, good.T_flange_camera, atol=2e-5)
    np.testing.assert_allclose(result.T_base_board, T_other_base @ good.T_base_board, atol=5e-5)
    assert result.uncertainty_mm == pytest.approx(good.uncertainty_mm, rel=0.05)


def test_another_flange_frame_moves_the_camera_by_it(good: HandEyeResult) -> None:
    recording = record(0)
    T_other_flange = moved(np.eye(4), np.array([0.0, 0.0, 0.0, 0.3, -0.2, 1.0]))
    result = solve_hand_eye(
        recording.Ts_base_flange @ T_other_flange, recording.Ts_camera_board, refine=recording.refine
    )
    np.testing.assert_allclose(T_other_flange @ result.T_flange_camera, good.T_flange_camera, atol=5e-5)


def test_few_poses_are_warned_of_and_very_few_refused() -> None:
    recording = record(5, 7)
    assert "too_few_poses" in codes(solved(recording))
    with pytest.raises(CalibrationError, match="at least 5") as error:
        solve_hand_eye(recording.Ts_base_flange[:4], recording.Ts_camera_board[:4])
    assert error.value.code == "too_few_poses"


def session_with_turns(turns: np.ndarray) -> Recording:
    """Return a session whose camera turns by these rotation vectors (N, 3) [°] in front of the board."""
    rng = np.random.default_rng(7)
    Ts = np.repeat(look_at_board(rng, tilt_deg=0.0)[None], len(turns), axis=0)
    middle = Ts[0] @ np.array([*(0.5 * np.array(BOARD.size_m)), 0.0, 1.0])
    for T, turn in zip(Ts, Rotation.from_rotvec(turns, degrees=True).as_matrix(), strict=True):
        T[:3, :3] = turn @ T[:3, :3]
        T[:3, 3] = middle[:3] - T[:3, :3] @ (*(0.5 * np.array(BOARD.size_m)), 0.0) + rng.uniform(-0.02, 0.02, 3)
    return record(7, len(turns), Ts_camera_board=Ts)


def test_similar_poses_are_refused() -> None:
    recording = session_with_turns(np.random.default_rng(1).uniform(-1.0, 1.0, (12, 3)))
    with pytest.raises(CalibrationError, match="alike") as error:
        solved(recording)
    assert error.value.code == "too_similar_poses"


def test_rather_similar_poses_are_warned_of() -> None:
    recording = session_with_turns(np.random.default_rng(1).uniform(-6.0, 6.0, (12, 3)))
    assert "too_similar_poses" in codes(solved(recording))


def test_rotations_about_one_axis_are_refused() -> None:
    turns = np.outer(np.linspace(-40.0, 40.0, 12), [0.0, 0.0, 1.0])
    with pytest.raises(CalibrationError, match="second axis") as error:
        solved(session_with_turns(turns))
    assert error.value.code == "planar_rotations"


def test_the_second_axis_may_be_weak_but_is_warned_of() -> None:
    turns = np.outer(np.linspace(-40.0, 40.0, 12), [0.0, 0.0, 1.0]) + 3.0 * np.array([[1, 0, 0], [-1, 0, 0]] * 6)
    result = solved(session_with_turns(turns))
    assert "planar_rotations" in codes(result)
    assert result.diversity < 0.9


@pytest.mark.parametrize("scale", [0.99, 1.04])
def test_squares_of_another_size_are_told_with_their_size(scale: float) -> None:
    result = solved(record(8, scale=scale))
    (warning,) = [w for w in result.warnings if w.code == "wrong_square_size"]
    assert "not 25.00 mm" in warning.message
    assert result.square_m == pytest.approx(scale * BOARD.square_m, rel=2e-3)
    assert distance(result.T_flange_camera, T_FLANGE_CAMERA)[0] <= 1.0


def test_a_print_off_by_a_thousandth_is_not_worth_a_word() -> None:
    assert "wrong_square_size" not in codes(solved(record(8, scale=1.001)))


def test_a_board_that_moved_is_told_with_when_and_how_far() -> None:
    moves = np.repeat(T_BASE_BOARD[None], 20, axis=0)
    moves[13:] = moved(T_BASE_BOARD, np.array([0.005, 0.0, 0.0, 0.0, 0.0, 0.0]))
    result = solved(record(9, T_base_boards=moves))
    (warning,) = [w for w in result.warnings if w.code == "board_moved"]
    assert warning.samples == tuple(str(i) for i in range(14, 21))
    assert float(warning.message.split("board ")[1].split(" mm")[0]) == pytest.approx(5.0, abs=0.7)
    assert set(result.dropped) == set(warning.samples)
    assert_covered(result)


def test_a_board_that_moved_early_leaves_the_samples_after_it() -> None:
    moves = np.repeat(T_BASE_BOARD[None], 20, axis=0)
    moves[6:] = moved(T_BASE_BOARD, np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.1]))
    result = solved(record(10, T_base_boards=moves))
    assert set(result.dropped) == {str(i) for i in range(1, 7)}
    assert_covered(result)


def test_too_few_samples_after_a_move_are_refused() -> None:
    moves = np.repeat(T_BASE_BOARD[None], 8, axis=0)
    moves[4:] = moved(T_BASE_BOARD, np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(CalibrationError) as error:
        solved(record(11, 8, T_base_boards=moves))
    assert error.value.code == "board_moved"


@pytest.mark.parametrize(
    ("mistake", "says"),
    [
        (lambda r: (inverse(r.Ts_base_flange), r.Ts_camera_board), "arm's poses are inverted"),
        (lambda r: (r.Ts_base_flange, inverse(r.Ts_camera_board)), "board's poses are inverted"),
        (lambda r: (r.Ts_base_flange[::-1], r.Ts_camera_board), "backwards"),
        (lambda r: (r.Ts_base_flange[:-1], r.Ts_camera_board[1:]), "pose after"),
        (lambda r: (r.Ts_base_flange[1:], r.Ts_camera_board[:-1]), "pose before"),
    ],
)
def test_poses_in_a_wrong_order_are_told(mistake, says: str) -> None:
    with pytest.raises(CalibrationError, match=says) as error:
        solve_hand_eye(*mistake(record(12, 12)))
    assert error.value.code == "flipped_order"


def test_samples_that_have_nothing_to_do_with_each_other_are_refused() -> None:
    one, other = record(13, 12), record(14, 12)
    with pytest.raises(CalibrationError) as error:
        solve_hand_eye(one.Ts_base_flange, other.Ts_camera_board)
    assert error.value.code == "inconsistent"


def test_poses_that_are_none_and_views_that_are_missing_are_refused() -> None:
    recording = record(15, 6)
    broken = recording.Ts_base_flange.copy()
    broken[2, :3, :3] *= 1.1
    with pytest.raises(CalibrationError, match=r"Ts_base_flange\[2\]"):
        solve_hand_eye(broken, recording.Ts_camera_board)
    with pytest.raises(CalibrationError, match="one each"):
        solve_hand_eye(recording.Ts_base_flange[:5], recording.Ts_camera_board)
    with pytest.raises(CalibrationError, match="one each"):
        solve_hand_eye(
            recording.Ts_base_flange,
            recording.Ts_camera_board,
            refine=Refinement(board=BOARD, camera=CAMERA, views=recording.views[:5]),
        )
    with pytest.raises(CalibrationError, match="different names"):
        solve_hand_eye(recording.Ts_base_flange, recording.Ts_camera_board, names=["a"] * 6)


def test_a_view_of_another_camera_is_refused() -> None:
    recording = record(16, 6)
    views = [replace(view, image_size=(1280, 720)) for view in recording.views]
    with pytest.raises(CalibrationError, match="1280"):
        solve_hand_eye(
            recording.Ts_base_flange,
            recording.Ts_camera_board,
            refine=Refinement(board=BOARD, camera=CAMERA, views=views),
        )
