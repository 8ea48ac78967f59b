"""Sheet: the printed page is true to scale as PNG and as PDF."""

from __future__ import annotations

import io
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calibration.board.board import Board
from calibration.board.detection import detect_board
from calibration.board.sheet import save_sheet
from calibration.errors import CalibrationError
from tests.support.errors import raises


def detected_extent_mm(page: np.ndarray, board: Board) -> np.ndarray:
    """Return width and height of the detected corners on a page at 600 dpi [mm]."""
    cropped = page[: 3 * (page.shape[0] // 3), : 3 * (page.shape[1] // 3)]
    view = detect_board(np.asarray(Image.fromarray(cropped).reduce(3)), board)
    return (view.pixels_px[-1] - view.pixels_px[0]) * 25.4 / 200


@pytest.mark.integration
def test_png_carries_its_resolution_and_is_true_to_scale(tmp_path: Path) -> None:
    save_sheet(Board(), tmp_path / "board.png")
    with Image.open(tmp_path / "board.png") as image:
        assert image.info["dpi"] == pytest.approx((600, 600), abs=0.01)
        page = np.asarray(image.convert("L"))
    assert page.shape == (round(210 / 25.4 * 600), round(297 / 25.4 * 600))
    np.testing.assert_allclose(detected_extent_mm(page, Board()), [150.0, 100.0], atol=0.05)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("board", "paper", "size_mm"),
    [
        (Board(), "A4", (297.0, 210.0)),
        (Board(), "Letter", (279.4, 215.9)),
        (Board(columns=7), "A4", (210.0, 297.0)),
        (Board(square_m=0.04, marker_m=0.03), "A3", (420.0, 297.0)),
    ],
    ids=["landscape", "Letter", "upright", "A3"],
)
def test_pdf_is_one_page_of_the_paper_at_600_dpi(
    tmp_path: Path, board: Board, paper: str, size_mm: tuple[float, float]
) -> None:
    save_sheet(board, tmp_path / "board.pdf", paper=paper)
    pdf = (tmp_path / "board.pdf").read_bytes()
    (box,) = re.findall(rb"/MediaBox \[ *([\d. ]+?) *\]", pdf)
    left, top, *page_points = map(float, box.split())
    assert (left, top) == (0.0, 0.0)
    np.testing.assert_allclose(np.array(page_points) * 25.4 / 72, size_mm, atol=25.4 / 600)
    # One image fills the page, so its resolution is the scale
    width_px, height_px = (int(re.findall(rb"/%b (\d+)" % edge, pdf)[0]) for edge in (b"Width", b"Height"))
    (placed,) = re.findall(rb"([\d.]+) 0 0 ([\d.]+) 0 0 cm", pdf)
    np.testing.assert_allclose([float(edge) for edge in placed], page_points)
    np.testing.assert_allclose([width_px * 72 / page_points[0], height_px * 72 / page_points[1]], 600.0, rtol=1e-9)


def read_page(pdf: bytes) -> np.ndarray:
    """Return the page image of a PDF by Pillow, whose CCITT stream is a TIFF without its header."""
    width, height, length = (int(re.findall(rb"/%b (\d+)" % key, pdf)[0]) for key in (b"Width", b"Height", b"Length"))
    start = pdf.index(b"stream\n", pdf.index(b"/CCITTFaxDecode")) + len(b"stream\n")
    tags = {256: width, 257: height, 258: 1, 259: 4, 262: 1, 273: 8 + 2 + 12 * 9 + 4, 277: 1, 278: height, 279: length}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    tiff = b"II*\0\x08\0\0\0" + struct.pack("<H", len(tags)) + entries + b"\0\0\0\0" + pdf[start : start + length]
    with Image.open(io.BytesIO(tiff)) as image:
        return np.asarray(image.convert("L"))


@pytest.mark.integration
def test_pdf_shows_the_board_at_its_size_and_the_same_page_as_the_png(tmp_path: Path) -> None:
    save_sheet(Board(), tmp_path / "board.pdf")
    page = read_page((tmp_path / "board.pdf").read_bytes())
    np.testing.assert_allclose(detected_extent_mm(page, Board()), [150.0, 100.0], atol=0.05)
    save_sheet(Board(), tmp_path / "board.png")
    with Image.open(tmp_path / "board.png") as image:
        np.testing.assert_array_equal(page, np.asarray(image.convert("L")))


@pytest.mark.parametrize(
    ("board", "name", "paper"),
    [(Board(), "b.svg", "A4"), (Board(), "b.pdf", "A7"), (Board(square_m=0.04, marker_m=0.03), "b.pdf", "A4")],
    ids=["format", "paper", "size"],
)
def test_unknown_formats_and_papers_and_large_boards_are_rejected(
    tmp_path: Path, board: Board, name: str, paper: str
) -> None:
    with raises(CalibrationError, "bad_sheet"):
        save_sheet(board, tmp_path / name, paper=paper)
    assert list(tmp_path.iterdir()) == []
