"""The board: OpenCV's own layout, true to scale on paper, and impossible ones refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calibration.board.board import Board, opencv_board
from calibration.board.detection import detect_board
from calibration.board.sheet import save_sheet
from calibration.errors import CalibrationError


@pytest.mark.parametrize("board", [Board(), Board(legacy=True), Board(columns=5, rows=7, dictionary="DICT_4X4_50")])
def test_the_picture_is_the_one_opencv_draws(board: Board) -> None:
    picture = board.image(70)
    theirs = opencv_board(board).generateImage(picture.shape[::-1])
    assert (picture != theirs).mean() < 0.03  # edges of markers are rounded differently
    np.testing.assert_allclose(board.corners_m, opencv_board(board).getChessboardCorners(), atol=1e-9)


def test_corners_lie_where_black_meets_black() -> None:
    board, view = Board(), detect_board(np.pad(Board().image(40), 40, constant_values=255), Board())
    assert len(view.ids) == 35
    # pixel centres are whole numbers, so the edge between pixels 39 and 40 is at 39.5
    np.testing.assert_allclose(view.pixels_px, 40 + board.corners_m[:, :2] * 40 / board.square_m - 0.5, atol=0.05)


def test_a_png_tells_its_resolution_and_is_true_to_scale(tmp_path: Path) -> None:
    board = Board()
    save_sheet(board, tmp_path / "board.png")
    with Image.open(tmp_path / "board.png") as image:
        assert image.info["dpi"] == pytest.approx((600, 600), abs=0.01)
        sheet = np.asarray(image.convert("L"))
    assert sheet.shape == (round(210 / 25.4 * 600), round(297 / 25.4 * 600))
    third = sheet[: 3 * (sheet.shape[0] // 3), : 3 * (sheet.shape[1] // 3)]
    view = detect_board(np.asarray(Image.fromarray(third).reduce(3)), board)
    extent_px = view.pixels_px[-1] - view.pixels_px[0]
    np.testing.assert_allclose(extent_px * 25.4 / 200, [150.0, 100.0], atol=0.05)


def test_a_pdf_is_a_page_of_the_paper_with_every_square_at_its_size(tmp_path: Path) -> None:
    board = Board()
    save_sheet(board, tmp_path / "board.pdf", paper="Letter")
    pdf = (tmp_path / "board.pdf").read_bytes()
    media = re.search(rb"MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf)
    assert media is not None
    assert [float(edge) for edge in media.groups()] == pytest.approx([792.0, 612.0], abs=0.01)
    edge = f"{25.0 * 72 / 25.4:.4f}".encode()
    assert pdf.count(b" " + edge + b" " + edge + b" re") == 24
    assert b"8 x 6 squares of 25 mm" in pdf
    table = int(pdf.rsplit(b"startxref\n", 1)[1].split()[0])
    assert pdf[table:].startswith(b"xref")
    for place in re.findall(rb"(\d{10}) 00000 n", pdf):
        assert re.match(rb"\d 0 obj", pdf[int(place) :])


@pytest.mark.parametrize(("name", "paper"), [("b.svg", "A4"), ("b.pdf", "A7")])
def test_unknown_formats_and_papers_are_refused(tmp_path: Path, name: str, paper: str) -> None:
    with pytest.raises(CalibrationError, match=r"known|not as"):
        save_sheet(Board(), tmp_path / name, paper=paper)
    assert list(tmp_path.iterdir()) == []


def test_a_board_larger_than_the_paper_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="does not fit A4"):
        save_sheet(Board(square_m=0.04, marker_m=0.03), tmp_path / "b.pdf")


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"columns": 2}, "at least 3 × 3"),
        ({"square_m": 25.0}, "give metres"),
        ({"marker_m": 0.024}, "allowed are"),
        ({"marker_m": 0.002}, "allowed are"),
        ({"dictionary": "DICT_5X5"}, "known: .*DICT_5X5_100"),
        ({"columns": 20, "rows": 20}, "larger dictionary"),
    ],
)
def test_impossible_boards_are_refused_with_what_is_possible(fields: dict, says: str) -> None:
    with pytest.raises(CalibrationError, match=says) as error:
        Board(**fields)
    assert error.value.code == "impossible_board"


def test_a_board_survives_its_dictionary() -> None:
    board = Board(columns=5, rows=7, square_m=0.03, marker_m=0.021)
    assert Board.from_dict(board.to_dict()) == board
    with pytest.raises(CalibrationError, match="fields"):
        Board.from_dict({"columns": 5})
