"""One HTML file, complete in itself, that shows whether a calibration can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.detection import BoardView
from calibration.hand_eye_result import HandEyeResult
from calibration.intrinsics import IntrinsicsResult
from calibration.results import Calibration


def write_report(
    path: Path,
    calibration: Calibration,
    result: HandEyeResult | IntrinsicsResult,
    *,
    views: Sequence[BoardView] = (),
    Ts_base_flange: np.ndarray | None = None,
    T_mount_camera_truth: np.ndarray | None = None,
) -> None:
    """Write the report of `result`.

    Args:
        path: of the HTML file; it is replaced.
        calibration: the result's origin, as saved.
        result: what is shown.
        views: one a sample, for the map of where corners were seen.
        Ts_base_flange: (N, 4, 4) the arm's poses, for the spread of the rotation axes (hand-eye).
        T_mount_camera_truth: (4, 4) the true camera pose, where it is known.
    """
    raise NotImplementedError
