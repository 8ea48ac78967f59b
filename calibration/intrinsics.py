"""Camera matrix and distortion from views of the board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.board import Board
from calibration.camera_model import CameraModel
from calibration.detection import BoardView
from calibration.errors import CalibrationWarning


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IntrinsicsResult:
    """A camera, and how well it explains the views."""

    camera: CameraModel
    """The camera found."""
    sd: np.ndarray
    """(9,) standard deviations of fx, fy, cx, cy [px], k1, k2, p1, p2, k3."""
    rms_px: float
    """Root mean square reprojection error over the corners of all views kept [px]."""
    holdout_px: float
    """The same over views that the camera was not fitted to (five folds) [px]."""
    view_names: tuple[str, ...]
    """(V,) names of all views given."""
    view_errors_px: np.ndarray
    """(V,) rms of each view under the camera found, refused ones included [px]."""
    refused: dict[str, str]
    """Views left out by name, with the reason."""
    coverage: np.ndarray
    """(6, 8) corners seen per cell of the image, rows by columns, in the views kept."""
    warnings: tuple[CalibrationWarning, ...]
    """`too_few_views`, `poor_coverage`, `little_tilt`, `high_error`."""


def calibrate_intrinsics(
    views: Sequence[BoardView], board: Board, *, names: Sequence[str] | None = None
) -> IntrinsicsResult:
    """Fit camera matrix and distortion to `views`; `names` are for messages ("1", "2", … when None).

    Raises:
        CalibrationError: `too_few_views`, `bad_view` (image sizes differ), `too_similar_poses` (all views parallel:
            focal length and distance cannot be told apart).
    """
    raise NotImplementedError
