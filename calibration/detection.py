"""Find the board's corners in an image, to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.board import Board
from calibration.errors import CalibrationWarning

MIN_CORNERS = 8
"""A view with fewer corners is refused: its pose would hang on too little."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoardView:
    """What one image shows of the board."""

    ids: np.ndarray
    """(N,) int, indices into `Board.corners_m`, rising."""
    pixels_px: np.ndarray
    """(N, 2) sub-pixel column and row; the centre of pixel (0, 0) is at 0.0."""
    sharpness: float
    """Width over which an edge of the board goes from dark to bright, as 1/px: 1 is razor sharp, below 0.25 blurred."""
    image_size: tuple[int, int]
    """Width and height of the image [px]."""
    warnings: tuple[CalibrationWarning, ...] = ()
    """`blurred`, `partly_hidden`: the view can be used, but a better one is easily had."""


def detect_board(image: np.ndarray, board: Board) -> BoardView:
    """Return the corners of `board` in `image`, (H, W, 3) RGB or (H, W) grey, uint8.

    Raises:
        CalibrationError: `bad_image`; `no_board` (nothing of it is seen); `wrong_board` (markers or a pattern of another
            one are seen); `hidden_board` (fewer than `MIN_CORNERS` corners); `blurred` (too blurred to use).
    """
    raise NotImplementedError
