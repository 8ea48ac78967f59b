"""Detection: corners to a fraction of a pixel, and the cause of each failure."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.board import detection
from calibration.board.board import Board
from calibration.board.detection import detect_board
from calibration.board.pose import estimate_board_pose
from calibration.errors import CalibrationError
from calibration.pose_checks import pose_distances_mm_deg
from hal.base.transforms import apply_increment, transform_points
from tests.support.calibration_data import BOARD, CAMERA, photograph, sample_T_camera_board

FRONT = np.eye(4)
FRONT[:3, 3] = (-0.1, -0.075, 0.26)
LEANING = apply_increment(FRONT, np.array([0.01, 0.0, 0.0, 0.3, -0.4, 0.2]))


def rejection_code(image: np.ndarray, board: Board = BOARD) -> str:
    with pytest.raises(CalibrationError) as caught:
        detect_board(image, board)
    return caught.value.code


@pytest.mark.parametrize("seed", range(4))
def test_corners_are_found_to_a_tenth_of_a_pixel_and_the_pose_to_a_fifth_of_a_millimetre(seed: int) -> None:
    T = sample_T_camera_board(np.random.default_rng(seed), distance_m=(0.22, 0.3))
    view = detect_board(photograph(T, seed=seed), BOARD)
    wanted = CAMERA.project(transform_points(T, BOARD.corners_m[view.ids]))
    assert len(view.ids) >= 30
    assert np.sqrt(np.mean((view.pixels_px - wanted) ** 2)) < 0.1
    found = estimate_board_pose(view, BOARD, CAMERA)
    mm, deg = pose_distances_mm_deg(found.T_camera_board, T)
    assert mm < 0.2
    assert deg < 0.2
    assert found.rms_px < 0.2
    assert view.warnings == ()


def test_colour_and_grey_images_give_the_same_corners() -> None:
    image = photograph(FRONT)
    np.testing.assert_array_equal(detect_board(image, BOARD).ids, detect_board(image[..., 0], BOARD).ids)


def test_array_shapes_of_opencv_5_are_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    image = photograph(FRONT)
    wanted = detect_board(image, BOARD)
    real = detection._detector(BOARD)

    class Five:
        def detectBoard(self, image):
            corners, ids, markers, marker_ids = real.detectBoard(image)
            return corners.reshape(-1, 2), ids.ravel(), markers, marker_ids.ravel()

    monkeypatch.setattr(detection, "_detector", lambda board: Five())
    five = detect_board(image, BOARD)
    np.testing.assert_array_equal(five.ids, wanted.ids)
    np.testing.assert_array_equal(five.pixels_px, wanted.pixels_px)


def test_partly_occluded_board_is_used_with_a_warning() -> None:
    image = photograph(FRONT)
    image[:, :330] = 90
    view = detect_board(image, BOARD)
    assert [w.code for w in view.warnings] == ["partly_hidden"]
    assert f"{len(view.ids)} of 35" in view.warnings[0].message


def test_mostly_occluded_board_is_rejected() -> None:
    image = photograph(FRONT)
    image[:, :420] = 90
    assert rejection_code(image) == "hidden_board"


def test_blur_lowers_the_sharpness_and_gives_a_warning() -> None:
    image = photograph(FRONT)
    sharp = detect_board(image, BOARD)
    smoothed = detect_board(cv2.GaussianBlur(image, (0, 0), 1.4), BOARD)
    assert sharp.sharpness > 0.5 > detection.BLURRED > smoothed.sharpness > detection.TOO_BLURRED
    assert "blurred" in [w.code for w in smoothed.warnings]


def test_motion_blur_along_one_axis_counts_as_blur() -> None:
    view = detect_board(cv2.filter2D(photograph(FRONT), -1, np.full((1, 5), 1.0 / 5.0)), BOARD)
    assert "blurred" in [w.code for w in view.warnings]


@pytest.mark.parametrize("T", [FRONT, LEANING], ids=["front", "leaning"])
@pytest.mark.parametrize("kernel", [np.full((1, 9), 1.0 / 9.0), np.full((7, 7), 1.0 / 49.0)], ids=["motion", "focus"])
def test_unreadable_blur_is_reported_as_blur(T: np.ndarray, kernel: np.ndarray) -> None:
    assert rejection_code(cv2.filter2D(photograph(T), -1, kernel)) == "blurred"


@pytest.mark.parametrize(
    "other",
    [
        replace(BOARD, dictionary="DICT_4X4_100"),
        replace(BOARD, dictionary="DICT_6X6_250"),
        replace(BOARD, columns=12, rows=9, square_m=0.0167, marker_m=0.012),
        replace(BOARD, columns=6, rows=8),
        replace(BOARD, legacy=True),
    ],
    ids=["4x4 markers", "6x6 markers", "more squares", "columns and rows exchanged", "drawn by an old OpenCV"],
)
def test_another_board_is_rejected(other: Board) -> None:
    assert rejection_code(photograph(FRONT, other)) == "wrong_board"


def test_absent_board_is_rejected() -> None:
    assert rejection_code(np.full((480, 640, 3), 120, np.uint8)) == "no_board"


@pytest.mark.parametrize("image", [np.zeros((480, 640, 3)), np.zeros((480, 640, 4), np.uint8), np.zeros(5, np.uint8)])
def test_arrays_that_are_no_image_are_rejected(image: np.ndarray) -> None:
    assert rejection_code(image) == "bad_image"
