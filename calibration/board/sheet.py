"""The board on a page at true scale, as a PDF or a PNG that carries its resolution."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from calibration.board.board import Board, paint_rectangles
from calibration.errors import CalibrationError
from hal.base.files import atomic_path
from hal.base.output_folder import check_output_file

PAPERS_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "Letter": (215.9, 279.4)}
"""Width and height, upright."""
DPI = 600
"""Resolution of the page: a pixel is 0.042 mm."""

_MARGIN_MM = 8.0  # printers leave the outer millimetres white, and the detector needs white around the board
_FOOT_MM = 18.0  # below the board, for ruler and text
_TEXT_MM = 3.2
_RULER_MM = 100
_PX_PER_MM = DPI / 25.4


def save_sheet(board: Board, path: Path, *, paper: str = "A4") -> None:
    """Write a page (`.pdf` or `.png`) to print at 100 %, with `board`, a ruler and a line of its settings.

    Raises:
        CalibrationError: `bad_sheet`: the board does not fit the paper, or the suffix or the paper is unknown.
    """
    page_mm = _page_mm(board, paper)
    if path.suffix.lower() not in (".pdf", ".png"):
        raise CalibrationError(f"sheet: unknown format ({path.name!r}, allowed .pdf, .png).", code="bad_sheet")
    page = _render_page(board, page_mm)
    with atomic_path(check_output_file(path)) as partial, partial.open("wb") as file:
        if path.suffix.lower() == ".pdf":
            page.save(file, format="PDF", resolution=DPI)
        else:
            page.save(file, format="PNG", dpi=(DPI, DPI))


def _page_mm(board: Board, paper: str) -> tuple[float, float]:
    """Return width and height of the page, upright or landscape as the board fits."""
    if paper not in PAPERS_MM:
        raise CalibrationError(f"sheet: unknown paper ({paper!r}, known: {', '.join(PAPERS_MM)}).", code="bad_sheet")
    width, height = (1e3 * edge for edge in board.size_m)
    short, long = PAPERS_MM[paper]
    for page in ((short, long), (long, short)):
        if width + 2 * _MARGIN_MM <= page[0] and height + 2 * _MARGIN_MM + _FOOT_MM <= page[1]:
            return page
    raise CalibrationError(
        f"sheet: the board of {width:g} × {height:g} mm does not fit {paper} with margins of {_MARGIN_MM:g} mm and the "
        "ruler. Take fewer or smaller squares, or a larger paper.",
        code="bad_sheet",
    )


def _render_page(board: Board, page_mm: tuple[float, float]) -> Image.Image:
    """Return the page in black and white (mode 1) at `DPI`."""
    width, height = (1e3 * edge for edge in board.size_m)
    left, top = (page_mm[0] - width) / 2, (page_mm[1] - _FOOT_MM - height) / 2
    ruler_y = top + height + 7.0
    black_mm = np.vstack(
        [1e3 * board.black_rectangles_m + (left, top, 0.0, 0.0), _ruler_mm((page_mm[0] - _RULER_MM) / 2, ruler_y)]
    )
    pixels = np.full((round(page_mm[1] * _PX_PER_MM), round(page_mm[0] * _PX_PER_MM)), 255, np.uint8)
    paint_rectangles(pixels, black_mm * _PX_PER_MM)
    page = Image.fromarray(pixels)
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(size=_TEXT_MM * _PX_PER_MM)
    settings = (
        f"{board.columns} x {board.rows} squares of {1e3 * board.square_m:g} mm, markers {1e3 * board.marker_m:g} mm, "
        f"{board.dictionary}{', legacy' if board.legacy else ''}"
    )
    advice = (
        f"Print at 100 %: the ruler must measure {_RULER_MM} mm. Measure the squares, and glue the sheet on a plate."
    )
    for baseline, line in ((ruler_y + 5.0, settings), (ruler_y + 9.5, advice)):
        draw.text((left * _PX_PER_MM, baseline * _PX_PER_MM), line, fill=0, font=font, anchor="ls")
    return page.convert("1")


def _ruler_mm(x: float, y: float) -> np.ndarray:
    """Return the rectangles (R, 4) of a ruler from `x` on, with its line at `y` and a tick each millimetre."""
    lengths = [4.0 if mm % 10 == 0 else 2.0 for mm in range(_RULER_MM + 1)]
    ticks = [(x + mm - 0.1, y - length, 0.2, length) for mm, length in enumerate(lengths)]
    return np.array([*ticks, (x - 0.1, y, _RULER_MM + 0.2, 0.2)])
