"""Detection: corners to a fraction of a pixel, and a board that cannot be used is told why."""

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
from calibration.transforms import distance, moved
from tests.support.calibration_data import BOARD, CAMERA, look_at_board, photograph

FRONT = np.eye(4)
FRONT[:3, 3] = (-0.1, -0.075, 0.26)
LEANING = moved(FRONT, np.array([0.01, 0.0, 0.0, 0.3, -0.4, 0.2]))


def refused(image: np.ndarray, board: Board = BOARD) -> str:
    with pytest.raises(CalibrationError) as error:
        detect_board(image, board)
    return error.value.code


@pytest.mark.parametrize("seed", range(4))
def test_corners_are_found_to_a_tenth_of_a_pixel_and_the_pose_to_a_fifth_of_a_millimetre(seed: int) -> None:
    T = look_at_board(np.random.default_rng(seed), distance_m=(0.22, 0.3))
    view = detect_board(photograph(T, seed=seed), BOARD)
    wanted = CAMERA.project(BOARD.corners_m[view.ids] @ T[:3, :3].T + T[:3, 3])
    assert len(view.ids) >= 30
    assert np.sqrt(np.mean((view.pixels_px - wanted) ** 2)) < 0.1
    found = estimate_board_pose(view, BOARD, CAMERA)
    mm, deg = distance(found.T_camera_board, T)
    assert mm < 0.2
    assert deg < 0.2
    assert found.rms_px < 0.2
    assert view.warnings == ()


def test_colour_and_grey_show_the_same() -> None:
    picture = photograph(FRONT)
    np.testing.assert_array_equal(detect_board(picture, BOARD).ids, detect_board(picture[..., 0], BOARD).ids)


def test_the_shapes_of_opencv_5_are_read_like_those_of_4(monkeypatch: pytest.MonkeyPatch) -> None:
    picture = photograph(FRONT)
    wanted = detect_board(picture, BOARD)
    real = detection._detector(BOARD)

    class Five:
        def detectBoard(self, image):
            corners, ids, markers, marker_ids = real.detectBoard(image)
            return corners.reshape(-1, 2), ids.ravel(), markers, marker_ids.ravel()

    monkeypatch.setattr(detection, "_detector", lambda board: Five())
    five = detect_board(picture, BOARD)
    np.testing.assert_array_equal(five.ids, wanted.ids)
    np.testing.assert_array_equal(five.pixels_px, wanted.pixels_px)


def test_a_partly_hidden_board_is_used_with_a_warning() -> None:
    picture = photograph(FRONT)
    picture[:, :330] = 90
    view = detect_board(picture, BOARD)
    assert [w.code for w in view.warnings] == ["partly_hidden"]
    assert f"{len(view.ids)} of 35" in view.warnings[0].message


def test_a_board_that_is_mostly_hidden_is_refused() -> None:
    picture = photograph(FRONT)
    picture[:, :420] = 90
    assert refused(picture) == "hidden_board"


def test_blur_lowers_the_sharpness_and_is_warned_of() -> None:
    picture = photograph(FRONT)
    sharp = detect_board(picture, BOARD)
    soft = detect_board(cv2.GaussianBlur(picture, (0, 0), 1.4), BOARD)
    assert sharp.sharpness > 0.5 > detection.BLURRED > soft.sharpness > detection.TOO_BLURRED
    assert "blurred" in [w.code for w in soft.warnings]


def test_motion_blur_along_one_axis_counts_as_blur() -> None:
    view = detect_board(cv2.filter2D(photograph(FRONT), -1, np.full((1, 5), 1.0 / 5.0)), BOARD)
    assert "blurred" in [w.code for w in view.warnings]


@pytest.mark.parametrize("T", [FRONT, LEANING], ids=["front", "leaning"])
@pytest.mark.parametrize("kernel", [np.full((1, 9), 1.0 / 9.0), np.full((7, 7), 1.0 / 49.0)], ids=["motion", "focus"])
def test_a_board_too_blurred_to_be_read_is_called_blurred(T: np.ndarray, kernel: np.ndarray) -> None:
    assert refused(cv2.filter2D(photograph(T), -1, kernel)) == "blurred"


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
def test_another_board_is_refused_as_such(other: Board) -> None:
    assert refused(photograph(FRONT, other)) == "wrong_board"


def test_no_board_is_told() -> None:
    assert refused(np.full((480, 640, 3), 120, np.uint8)) == "no_board"


@pytest.mark.parametrize("image", [np.zeros((480, 640, 3)), np.zeros((480, 640, 4), np.uint8), np.zeros(5, np.uint8)])
def test_what_is_no_image_is_refused(image: np.ndarray) -> None:
    assert refused(image) == "bad_image"
