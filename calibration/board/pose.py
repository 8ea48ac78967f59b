"""Pose of the board from one view."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibration.board.board import Board
from calibration.board.detection import MIN_CORNERS, BoardView
from calibration.camera_model import CameraModel
from calibration.errors import CalibrationError
from calibration.pose_checks import pose_distances_mm_deg
from hal.base.transforms import make_pose, transform_points

AMBIGUOUS = 0.8
"""Ratio of the errors above which the two solutions of a plane cannot be distinguished."""

_SAME_DEG = 2.0  # two solutions closer than this have converged to one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoardPose:
    """The board in the camera frame, from one view."""

    T_camera_board: np.ndarray
    """(4, 4)."""
    rms_px: float
    """Root mean square distance between detected and projected corners [px]."""
    ambiguity: float
    """Error of this solution over that of the mirrored one, 0 … 1; 0 when both coincide."""


def estimate_board_pose(view: BoardView, board: Board, camera: CameraModel) -> BoardPose:
    """Return the better of both planar solutions (IPPE), refined by their reprojection error.

    Raises:
        CalibrationError: `bad_view` (too few corners or corners on one line, unknown ids, another image size than the
            camera's), or `ambiguous_pose` (the mirrored solution explains the view as well).
    """
    points = check_view(view, board, camera)
    pixels = np.ascontiguousarray(view.pixels_px)
    _, rotations, positions, _ = cv2.solvePnPGeneric(
        points, pixels, camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_IPPE
    )
    found = []
    # IPPE (Collins and Bartoli 2014) solves for a homography; the reprojection errors compared below need a refinement
    for rotation, position in zip(rotations, positions, strict=True):
        rotation, position = cv2.solvePnPRefineLM(  # noqa: PLW2901
            points, pixels, camera.matrix, camera.distortion, rotation.copy(), position.copy()
        )
        T = make_pose(cv2.Rodrigues(rotation)[0], np.ravel(position))
        # A pose behind the camera may project to the same pixels, but forms no image
        if T[2, 3] > 0.0:
            found.append((compute_rms_px(T, view, board, camera), T))
    if not found:
        raise CalibrationError(
            "board pose: none in front of the camera explains this view. Check the camera's intrinsics.",
            code="bad_view",
        )
    found.sort(key=lambda solution: solution[0])
    (error, T), (other_error, other) = found[0], found[-1]
    coincide = float(pose_distances_mm_deg(T, other)[1]) < _SAME_DEG
    ambiguity = 0.0 if coincide else error / max(other_error, 1e-12)
    if ambiguity > AMBIGUOUS:
        raise CalibrationError(
            f"board pose: the tilt is ambiguous ({error:.2f} px, mirrored {other_error:.2f} px). "
            "Move nearer or view the board more from the side.",
            code="ambiguous_pose",
        )
    return BoardPose(T_camera_board=T, rms_px=error, ambiguity=ambiguity)


def check_view(view: BoardView, board: Board, camera: CameraModel) -> np.ndarray:
    """Return the corners (N, 3) of `view` in the board frame [m]; raises as `estimate_board_pose` does."""
    if view.image_size != camera.size:
        raise CalibrationError(
            f"view: image size {view.image_size} px differs from the camera's {camera.size} px.", code="bad_view"
        )
    return check_corners(view, board)


def check_corners(view: BoardView, board: Board) -> np.ndarray:
    """Return the corners (N, 3) of `view` in the board frame [m].

    Raises:
        CalibrationError: `bad_view`: too few corners, corners on one line, or ids the board does not have.
    """
    corners = board.corners_m
    if len(view.ids) < MIN_CORNERS or view.ids.min() < 0 or view.ids.max() >= len(corners):
        raise CalibrationError(
            f"view: bad corner ids ({view.ids}, allowed from {MIN_CORNERS} ids of 0 … {len(corners) - 1}).",
            code="bad_view",
        )
    points = corners[view.ids]
    if np.linalg.matrix_rank(points - points.mean(axis=0), tol=0.1 * board.square_m) < 2:
        raise CalibrationError("view: all detected corners are on one line. Show more of the board.", code="bad_view")
    return points


def compute_rms_px(T_camera_board: np.ndarray, view: BoardView, board: Board, camera: CameraModel) -> float:
    """Return the root mean square distance between detected and projected corners [px]."""
    points = transform_points(T_camera_board, board.corners_m[view.ids])
    return float(np.sqrt(np.mean(np.sum((camera.project(points) - view.pixels_px) ** 2, axis=1))))
