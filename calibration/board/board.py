"""The ChArUco board: a chessboard with a marker in each white square, so that every part of it identifies itself.

Board frame: the origin is the outer top-left corner of the print as read, x runs right along the columns, y
down along the rows, and z INTO the print (away from the reader). For a camera looking straight at an upright board
R_camera_board is the identity. The frame is OpenCV's.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from calibration.errors import CalibrationError

_MIN_GAP_MODULES = 0.7
"""White between marker and square, in modules of the marker; OpenCV warns of missed corners below that value."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """Size and markers of one board; the default fits A4 and Letter, and a D405 at 0.15 m to 0.45 m.

    Raises:
        CalibrationError: `impossible_board`.
    """

    columns: int = 8
    """Squares along x."""
    rows: int = 6
    """Squares along y."""
    square_m: float = 0.025
    """Edge of a square [m], measured on the print."""
    marker_m: float = 0.018
    """Edge of a marker with its black border [m]."""
    dictionary: str = "DICT_5X5_100"
    """One of OpenCV's predefined marker families."""
    legacy: bool = False
    """True for a board with an even number of rows drawn by OpenCV before 4.6: its markers are on the other colour."""

    def __post_init__(self) -> None:
        families = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        if self.dictionary not in families:
            raise _impossible(f"unknown dictionary ({self.dictionary!r}, known: {', '.join(families)})")
        # With two columns or rows all inner corners are on one line, which determines no homography
        if self.columns < 3 or self.rows < 3:
            raise _impossible(f"too few squares ({self.columns} × {self.rows}, allowed from 3 × 3)")
        if not 0.002 <= self.square_m <= 0.5:
            raise _impossible(f"square size out of range ({self.square_m} m, allowed 0.002 to 0.5 m)")
        dictionary = _dictionary(self.dictionary)
        available, needed = len(dictionary.bytesList), self.columns * self.rows // 2
        if needed > available:
            raise _impossible(f"{needed} markers needed, {self.dictionary} has {available}; take a larger dictionary")
        # A square holds the marker with its border of one module and the white gap on both sides
        largest = self.square_m / (1.0 + 2.0 * _MIN_GAP_MODULES / (dictionary.markerSize + 2))
        if not 0.2 * self.square_m <= self.marker_m <= largest:
            raise _impossible(
                f"marker size out of range ({1e3 * self.marker_m:g} mm in squares of {1e3 * self.square_m:g} mm, "
                "allowed "
                f"{200 * self.square_m:.1f} to {1e3 * largest:.1f} mm, which leaves white around each)"
            )

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the print without margins [m]."""
        return self.columns * self.square_m, self.rows * self.square_m

    @property
    def corners_m(self) -> np.ndarray:
        """(N, 3) inner corners in the board frame by their id, row by row from the top left [m]; z is 0."""
        y, x = np.mgrid[1 : self.rows, 1 : self.columns]
        return self.square_m * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)

    @property
    def black_rectangles_m(self) -> np.ndarray:
        """(R, 4) black rectangles in the board frame: x, y, width and height [m]."""
        squares = [
            (column * self.square_m, row * self.square_m, self.square_m, self.square_m)
            for row in range(self.rows)
            for column in range(self.columns)
            if (row + column) % 2 == int(self.legacy and self.rows % 2 == 0)
        ]
        # OpenCV's markers have a black border of one module on each side (`borderBits`)
        board, modules = make_opencv_board(self), _dictionary(self.dictionary).markerSize + 2
        module_m = self.marker_m / modules
        for marker, outline in zip(np.ravel(board.getIds()), board.getObjPoints(), strict=True):
            x, y = np.reshape(outline, (4, 3))[0, :2]
            bits = cv2.aruco.generateImageMarker(_dictionary(self.dictionary), int(marker), modules)
            for row, line in enumerate(bits == 0):
                # One rectangle for each run of black modules, so that no hairline shows between them
                edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
                for start, end in edges.reshape(-1, 2):
                    squares.append((x + start * module_m, y + row * module_m, (end - start) * module_m, module_m))
        return np.array(squares)

    def image(self, pixels_per_square: int) -> np.ndarray:
        """Return the print without margins as (rows · P, columns · P) uint8, 0 and 255, for a texture."""
        picture = np.full((self.rows * pixels_per_square, self.columns * pixels_per_square), 255, np.uint8)
        paint_rectangles(picture, self.black_rectangles_m * (pixels_per_square / self.square_m))
        return picture

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for a JSON file."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Board:
        """Return the board of `to_dict()`.

        Raises:
            CalibrationError: unknown or missing fields, or an impossible board.
        """
        names = {field.name for field in fields(cls)}
        if not isinstance(values, dict) or set(values) != names:
            raise _impossible(f"wrong fields ({sorted(values)}, expected {sorted(names)})")
        try:
            return cls(**values)
        except TypeError as error:
            raise _impossible(f"the fields cannot be used ({values}): {error}") from error


def paint_rectangles(picture: np.ndarray, black_px: np.ndarray) -> None:
    """Blacken rectangles (R, 4) of x, y, width, height [px], to the nearest pixel edges."""
    left_top = np.rint(black_px[:, :2]).astype(int)
    right_bottom = np.rint(black_px[:, :2] + black_px[:, 2:]).astype(int)
    for (left, top), (right, bottom) in zip(left_top, right_bottom, strict=True):
        picture[top:bottom, left:right] = 0


@lru_cache(maxsize=8)
def make_opencv_board(board: Board) -> Any:
    """Return OpenCV's object for `board`."""
    size, dictionary = (board.columns, board.rows), _dictionary(board.dictionary)
    opencv = cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary)
    opencv.setLegacyPattern(board.legacy)
    return opencv


def _dictionary(name: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _impossible(what: str) -> CalibrationError:
    return CalibrationError(f"board: {what}.", code="impossible_board")
