"""Calibration of camera matrix and distortion from views of the board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calibration.board.board import Board
from calibration.board.detection import BoardView
from calibration.board.pose import check_corners, compute_rms_px
from calibration.camera_model import CameraModel
from calibration.errors import CalibrationError, CalibrationWarning
from hal.base.transforms import make_pose

MIN_VIEWS = 5
"""Fewer views are rejected."""
GOOD_VIEWS = 10
"""Fewer views get the warning `too_few_views`."""

_CELLS = (6, 8)  # rows and columns of the coverage map
_FOLDS = 5
_OUTLIER = 3.0  # a view is rejected when its error is this multiple of the median, …
_MIN_OUTLIER_PX = 0.5  # … and at least this [px]
_MIN_TILT_DEG, _GOOD_TILT_DEG = 5.0, 20.0
_GOOD_COVERAGE = 0.7
_GOOD_RMS_PX = 0.5
_EPSILON = 1e-12  # relative change below which the adjustment has converged


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IntrinsicsResult:
    """A camera with its reprojection errors and standard deviations."""

    camera: CameraModel
    """The estimated camera."""
    sd: np.ndarray
    """(9,) standard deviations of fx, fy, cx, cy [px], k1, k2, p1, p2, k3."""
    rms_px: float
    """Root mean square reprojection error over the corners of all views kept [px]."""
    holdout_px: float
    """The same over views held out from the fit (five folds) [px]."""
    view_names: tuple[str, ...]
    """(V,) names of all views given."""
    view_errors_px: np.ndarray
    """(V,) rms of each view under the estimated camera, rejected ones included [px]."""
    rejected: dict[str, str]
    """Views left out by name, with the reason."""
    coverage: np.ndarray
    """(6, 8) detected corners per cell of the image, rows by columns, in the views kept."""
    warnings: tuple[CalibrationWarning, ...]
    """`too_few_views`, `poor_coverage`, `little_tilt`, `high_error`."""


def calibrate_intrinsics(
    views: Sequence[BoardView], board: Board, *, names: Sequence[str] | None = None
) -> IntrinsicsResult:
    """Fit camera matrix and distortion to `views`; `names` are for messages ("1", "2", … when None).

    Raises:
        CalibrationError: `too_few_views`, `bad_view` (image sizes differ), `too_similar_poses` (all views parallel:
            focal length and distance cannot be separated).
    """
    names = tuple(str(i) for i in range(1, len(views) + 1)) if names is None else tuple(names)
    _check_views(views, board, names)
    kept, rejected = list(range(len(views))), {}
    while True:
        camera, sd, errors, rotations = _fit([views[i] for i in kept], board)
        median = float(np.median(errors))
        # One view at a time: a bad one raises the errors of the others too
        worst = int(np.argmax(errors))
        if errors[worst] < max(_OUTLIER * median, _MIN_OUTLIER_PX):
            break
        rejected[names[kept[worst]]] = (
            f"its reprojection error is {errors[worst]:.2f} px, that of the other views {median:.2f} px: "
            "blurred, partly occluded, or a bent board"
        )
        del kept[worst]
        _check_number(len(kept))
    tilts = _tilts_deg(rotations)
    if tilts.max() < _MIN_TILT_DEG:
        raise CalibrationError(
            f"views: the tilt is too small (maximum {tilts.max():.1f}°, needed from {_MIN_TILT_DEG:g}°) to "
            "separate focal length "
            "and distance. "
            f"Tilt the board by {_GOOD_TILT_DEG:g}° to 45° in several directions.",
            code="too_similar_poses",
        )
    coverage = _coverage([views[i] for i in kept])
    rms_px = float(np.sqrt(np.average(errors**2, weights=[len(views[i].ids) for i in kept])))
    return IntrinsicsResult(
        camera=camera,
        sd=sd,
        rms_px=rms_px,
        holdout_px=_holdout_px([views[i] for i in kept], board),
        view_names=names,
        view_errors_px=np.array([_view_error_px(view, board, camera) for view in views]),
        rejected=rejected,
        coverage=coverage,
        warnings=tuple(_warnings(len(kept), coverage, float(tilts.max()), rms_px)),
    )


def _check_views(views: Sequence[BoardView], board: Board, names: tuple[str, ...]) -> None:
    _check_number(len(views))
    if len(set(names)) != len(views):
        raise CalibrationError(
            f"views: {len(views)} views need {len(views)} different names ({names}).", code="bad_view"
        )
    for name, view in zip(names, views, strict=True):
        if view.image_size != views[0].image_size:
            raise CalibrationError(
                f"view {name}: its size {view.image_size} px differs from {views[0].image_size} px of the first.",
                code="bad_view",
            )
        check_corners(view, board)


def _check_number(n: int) -> None:
    if n < MIN_VIEWS:
        raise CalibrationError(
            f"views: too few are usable ({n}, needed from {MIN_VIEWS}, good {2 * GOOD_VIEWS}). Take more.",
            code="too_few_views",
        )


def _fit(views: Sequence[BoardView], board: Board) -> tuple[CameraModel, np.ndarray, np.ndarray, np.ndarray]:
    """Return the camera, its standard deviations (9,), the error of each view (V,) [px] and its rotation (V, 3, 3)."""
    size = views[0].image_size
    # OpenCV calibrates from float32 points only
    points = [np.float32(board.corners_m[view.ids]).reshape(-1, 1, 3) for view in views]
    pixels = [np.float32(view.pixels_px).reshape(-1, 1, 2) for view in views]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, _EPSILON)
    try:
        _, matrix, distortion, rotation_vectors, _, sd, _, errors = cv2.calibrateCameraExtended(
            points, pixels, size, np.eye(3), np.zeros(5), criteria=criteria
        )
    except cv2.error as error:
        raise CalibrationError(
            f"views: no camera explains them ({error.err}). Take views with more tilt.", code="too_similar_poses"
        ) from error
    camera = CameraModel(matrix=matrix, distortion=np.ravel(distortion)[:5], size=size)
    rotations = np.array([cv2.Rodrigues(vector)[0] for vector in rotation_vectors])
    return camera, np.ravel(sd)[:9], np.ravel(errors), rotations


def _view_error_px(view: BoardView, board: Board, camera: CameraModel) -> float:
    """Return the rms error of `view` at its best pose [px]."""
    points, pixels = board.corners_m[view.ids], np.ascontiguousarray(view.pixels_px)
    _, rotation, position = cv2.solvePnP(points, pixels, camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_IPPE)
    rotation, position = cv2.solvePnPRefineLM(points, pixels, camera.matrix, camera.distortion, rotation, position)
    T_camera_board = make_pose(cv2.Rodrigues(rotation)[0], np.ravel(position))
    return compute_rms_px(T_camera_board, view, board, camera)


def _holdout_px(views: Sequence[BoardView], board: Board) -> float:
    squares, counts = 0.0, 0
    for fold in range(_FOLDS):
        camera = _fit([view for i, view in enumerate(views) if i % _FOLDS != fold], board)[0]
        for view in views[fold::_FOLDS]:
            squares += _view_error_px(view, board, camera) ** 2 * len(view.ids)
            counts += len(view.ids)
    return float(np.sqrt(squares / counts))


def _tilts_deg(rotations: np.ndarray) -> np.ndarray:
    """Return the angle of each board to the image plane (V,) [°]."""
    return np.degrees(np.arccos(np.clip(np.abs(rotations[:, 2, 2]), 0.0, 1.0)))


def _coverage(views: Sequence[BoardView]) -> np.ndarray:
    width, height = views[0].image_size
    pixels = np.vstack([view.pixels_px for view in views])
    counts, _, _ = np.histogram2d(pixels[:, 1], pixels[:, 0], bins=_CELLS, range=((0, height), (0, width)))
    return counts.astype(int)


def _warnings(n: int, coverage: np.ndarray, tilt_deg: float, rms_px: float) -> list[CalibrationWarning]:
    covered, rows, columns = float((coverage > 0).mean()), *_CELLS
    checks = {
        "too_few_views": (n < GOOD_VIEWS, f"views: {n} are usable, {2 * GOOD_VIEWS} are good."),
        "poor_coverage": (
            covered < _GOOD_COVERAGE,
            f"views: corners are in {100 * covered:.0f} % of the image ({rows} × {columns} cells). Show the board in "
            "the corners and at the edges too, where distortion is greatest.",
        ),
        "little_tilt": (
            tilt_deg < _GOOD_TILT_DEG,
            f"views: the maximum tilt is {tilt_deg:.0f}°; {_GOOD_TILT_DEG:g}° to 45° determine the focal length well.",
        ),
        "high_error": (
            rms_px > _GOOD_RMS_PX,
            f"views: the rms error is {rms_px:.2f} px, up to {_GOOD_RMS_PX} px is good. Check that the board is "
            "flat and the "
            "images are sharp.",
        ),
    }
    return [
        CalibrationWarning(code=code, message=message) for code, (is_raised, message) in checks.items() if is_raised
    ]
