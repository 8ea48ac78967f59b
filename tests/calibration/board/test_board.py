"""Board: OpenCV's layout, and errors for impossible boards."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.board.board import Board, make_opencv_board
from calibration.board.detection import detect_board
from calibration.errors import CalibrationError
from tests.support.errors import raises


@pytest.mark.parametrize("board", [Board(), Board(legacy=True), Board(columns=5, rows=7, dictionary="DICT_4X4_50")])
def test_image_equals_opencvs(board: Board) -> None:
    picture = board.image(70)
    theirs = make_opencv_board(board).generateImage(picture.shape[::-1])
    assert (picture != theirs).mean() < 0.03  # edges of markers are rounded differently
    np.testing.assert_allclose(board.corners_m, make_opencv_board(board).getChessboardCorners(), atol=1e-9)


def test_corners_are_where_black_squares_meet() -> None:
    board, view = Board(), detect_board(np.pad(Board().image(40), 40, constant_values=255), Board())
    assert len(view.ids) == 35
    # pixel centres are whole numbers, so the edge between pixels 39 and 40 is at 39.5
    np.testing.assert_allclose(view.pixels_px, 40 + board.corners_m[:, :2] * 40 / board.square_m - 0.5, atol=0.05)


@pytest.mark.parametrize(
    "fields",
    [
        {"columns": 2},
        {"square_m": 25.0},
        {"marker_m": 0.024},
        {"marker_m": 0.002},
        {"dictionary": "DICT_5X5"},
        {"columns": 20, "rows": 20},
    ],
    ids=lambda fields: next(iter(fields)),
)
def test_impossible_boards_are_rejected(fields: dict) -> None:
    with raises(CalibrationError, "impossible_board"):
        Board(**fields)


def test_error_names_value_range_and_remedy() -> None:
    with raises(CalibrationError, "impossible_board") as caught:
        Board(columns=20, rows=20)
    assert "200 markers needed" in str(caught.value)
    assert "DICT_5X5_100 has 100" in str(caught.value)
    assert "larger dictionary" in str(caught.value)


def test_board_survives_its_dictionary() -> None:
    board = Board(columns=5, rows=7, square_m=0.03, marker_m=0.021)
    assert Board.from_dict(board.to_dict()) == board
    for broken in ({"columns": 5}, board.to_dict() | {"rows": "7"}):
        with raises(CalibrationError, "impossible_board"):
            Board.from_dict(broken)
