"""Where the board is in one view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.board import Board
from calibration.camera_model import CameraModel
from calibration.detection import BoardView


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoardPose:
    """The board in the camera frame, from one view."""

    T_camera_board: np.ndarray
    """(4, 4) pose of the board."""
    rms_px: float
    """Root mean square distance between seen and projected corners [px]."""
    ambiguity: float
    """Error of this solution over that of the mirrored one, 0 … 1; near 1 the two cannot be told apart."""


def estimate_board_pose(view: BoardView, board: Board, camera: CameraModel) -> BoardPose:
    """Return the board's pose: both planar solutions (IPPE), the better one refined by its reprojection error.

    Raises:
        CalibrationError: `bad_view` (corners on one line, ids the board does not have, another image size than the
            camera's), or `ambiguous_pose` (the mirrored solution explains the view as well).
    """
    raise NotImplementedError
