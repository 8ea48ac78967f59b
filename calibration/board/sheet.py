"""The board on a page at true scale, as a vector PDF or a PNG that tells its resolution."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.board.board import Board, paint
from calibration.errors import CalibrationError

PAPERS_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "Letter": (215.9, 279.4)}
"""Width and height, upright."""

_MARGIN_MM = 8.0  # printers leave the outer millimetres blank, and the board wants white around it
_FOOT_MM = 18.0  # under the board, for ruler and text
_TEXT_MM = 3.2
_RULER_MM = 100
_DPI = 600


def save_sheet(board: Board, path: Path, *, paper: str = "A4") -> None:
    """Write a page (`.pdf` or `.png`) to print at 100 %: `board`, a ruler and a line that says what it is.

    Raises:
        CalibrationError: the board does not fit the paper, or the suffix or the paper is unknown.
    """
    page = _page_mm(board, paper)
    black, text = _draw(board, page)
    if path.suffix.lower() == ".pdf":
        path.write_bytes(_pdf(page, black, text))
    elif path.suffix.lower() == ".png":
        _save_png(path, page, black, text)
    else:
        raise CalibrationError("bad_sheet", f"a board is written as .pdf or .png, not as {path.name!r}.")


def _page_mm(board: Board, paper: str) -> tuple[float, float]:
    """Return width and height of the page, upright or on its side as the board fits."""
    if paper not in PAPERS_MM:
        raise CalibrationError("bad_sheet", f"there is no paper {paper!r}; known: {', '.join(PAPERS_MM)}.")
    width, height = (1e3 * edge for edge in board.size_m)
    short, long = PAPERS_MM[paper]
    for page in ((short, long), (long, short)):
        if width + 2 * _MARGIN_MM <= page[0] and height + 2 * _MARGIN_MM + _FOOT_MM <= page[1]:
            return page
    raise CalibrationError(
        "bad_sheet",
        f"a board of {width:g} × {height:g} mm does not fit {paper} with margins of {_MARGIN_MM:g} mm and the ruler; "
        "take fewer or smaller squares, or a larger paper.",
    )


def _draw(board: Board, page: tuple[float, float]) -> tuple[np.ndarray, list[tuple[float, float, str]]]:
    """Return black rectangles (R, 4) of x, y, width, height from the page's top left, and (x, baseline, text) [mm]."""
    width, height = (1e3 * edge for edge in board.size_m)
    left, top = (page[0] - width) / 2, (page[1] - _FOOT_MM - height) / 2
    ruler_x, ruler_y = (page[0] - _RULER_MM) / 2, top + height + 7.0
    ticks = [
        (ruler_x + mm - 0.1, ruler_y - (4.0 if mm % 10 == 0 else 2.0), 0.2, 4.0 if mm % 10 == 0 else 2.0)
        for mm in range(_RULER_MM + 1)
    ]
    line = [(ruler_x - 0.1, ruler_y, _RULER_MM + 0.2, 0.2)]
    black = np.vstack([1e3 * board.black_m + (left, top, 0.0, 0.0), ticks, line])
    says = (
        f"{board.columns} x {board.rows} squares of {1e3 * board.square_m:g} mm, markers {1e3 * board.marker_m:g} mm, "
        f"{board.dictionary}{', legacy' if board.legacy else ''}"
    )
    advice = (
        f"Print at 100 %: the ruler must measure {_RULER_MM} mm. Measure the squares, and glue the sheet on a plate."
    )
    return black, [(left, ruler_y + 5.0, says), (left, ruler_y + 9.5, advice)]


def _pdf(page: tuple[float, float], black: np.ndarray, text: list[tuple[float, float, str]]) -> bytes:
    """Return a PDF of one page: rectangles filled black, and lines of text in Helvetica."""
    point = 72.0 / 25.4
    drawing = [
        f"{x * point:.4f} {(page[1] - y - h) * point:.4f} {w * point:.4f} {h * point:.4f} re" for x, y, w, h in black
    ]
    drawing.append("f")
    for x, y, words in text:
        place = f"{x * point:.3f} {(page[1] - y) * point:.3f}"
        drawing.append(f"BT /F1 {_TEXT_MM * point:.2f} Tf {place} Td ({words}) Tj ET")
    stream = "\n".join(drawing).encode("ascii")
    size = f"{page[0] * point:.4f} {page[1] * point:.4f}"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {size}] /Contents 4 0 R "
        f"/Resources << /Font << /F1 5 0 R >> >> >>".encode("ascii"),
        b"<< /Length %d >>\nstream\n%b\nendstream" % (len(stream), stream),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out, places = b"%PDF-1.6\n", []
    for number, body in enumerate(objects, start=1):
        places.append(len(out))
        out += b"%d 0 obj\n%b\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    out += b"xref\n0 %d\n0000000000 65535 f \n%b" % (len(objects) + 1, table)
    end = b"trailer << /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n"
    return out + end % (len(objects) + 1, out.rindex(b"xref\n0"))


def _save_png(path: Path, page: tuple[float, float], black: np.ndarray, text: list[tuple[float, float, str]]) -> None:
    from PIL import Image, ImageDraw, ImageFont

    scale = _DPI / 25.4
    picture = np.full((round(page[1] * scale), round(page[0] * scale)), 255, np.uint8)
    paint(picture, black * scale)
    image = Image.fromarray(picture)
    font = ImageFont.load_default(size=_TEXT_MM * scale)
    for x, y, words in text:
        ImageDraw.Draw(image).text((x * scale, y * scale), words, fill=0, font=font, anchor="ls")
    image.convert("1").save(path, dpi=(_DPI, _DPI))
