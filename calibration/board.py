"""The ChArUco board: a chessboard with a marker in each white square, so that any part of it tells which part it is.

Board frame: the origin is the outer top-left corner of the print as one reads it, x runs right along the columns, y
down along the rows, and z INTO the print (away from the reader). A camera looking straight at an upright board has
the identity as its rotation T_camera_board. It is the frame of OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """Size and code of one board. The default fits A4 and Letter, and a D405 from 0.15 m to 0.45 m."""

    columns: int = 8
    """Squares along x."""
    rows: int = 6
    """Squares along y."""
    square_m: float = 0.025
    """Edge of a square [m]; measure the print."""
    marker_m: float = 0.018
    """Edge of a marker with its black border [m]."""
    dictionary: str = "DICT_5X5_100"
    """Which of OpenCV's predefined marker families."""
    legacy: bool = False
    """True for a board that OpenCV before 4.6 drew with an even number of rows: its markers sit on the other colour."""

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the print without margins [m]."""
        return self.columns * self.square_m, self.rows * self.square_m

    @property
    def corners_m(self) -> np.ndarray:
        """(N, 3) inner corners in the board frame by their id, row by row from the top left [m]; z is 0."""
        raise NotImplementedError

    def image(self, pixels_per_square: int) -> np.ndarray:
        """Return the print without margins as (rows · P, columns · P) uint8, 0 and 255, for a texture."""
        raise NotImplementedError

    def save_sheet(self, path: Path, *, paper: str = "A4") -> None:
        """Write a page (`.pdf` or `.png`) to print at 100 %: the board, a ruler and a line that says what it is.

        Raises:
            CalibrationError: the board does not fit the paper, or the suffix or the paper is unknown.
        """
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for a JSON file."""
        raise NotImplementedError

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> Board:
        """Return the board of `to_dict()`.

        Raises:
            CalibrationError: unknown or missing fields, or an impossible board.
        """
        raise NotImplementedError
