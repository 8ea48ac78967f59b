"""Where the board is in one view."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibration.board.board import Board
from calibration.board.detection import MIN_CORNERS, BoardView
from calibration.camera_model import CameraModel
from calibration.errors import CalibrationError
from calibration.transforms import distance

AMBIGUOUS = 0.8
"""Above this ratio of errors the two solutions of a plane cannot be told apart."""

_SAME_DEG = 2.0  # nearer than this they are one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoardPose:
    """The board in the camera frame, from one view."""

    T_camera_board: np.ndarray
    """(4, 4) pose of the board."""
    rms_px: float
    """Root mean square distance between seen and projected corners [px]."""
    ambiguity: float
    """Error of this solution over that of the mirrored one, 0 … 1; 0 when both are one."""


def estimate_board_pose(view: BoardView, board: Board, camera: CameraModel) -> BoardPose:
    """Return the board's pose: both planar solutions (IPPE), refined by their reprojection error, and the better one.

    Raises:
        CalibrationError: `bad_view` (too few corners or corners on one line, ids the board does not have, another image
            size than the camera's), or `ambiguous_pose` (the mirrored solution explains the view as well).
    """
    points = check_view(view, board, camera)
    pixels = np.ascontiguousarray(view.pixels_px)
    _, rotations, positions, _ = cv2.solvePnPGeneric(
        points, pixels, camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_IPPE
    )
    found = []
    for rotation, position in zip(rotations, positions, strict=True):
        rotation, position = cv2.solvePnPRefineLM(  # noqa: PLW2901
            points, pixels, camera.matrix, camera.distortion, rotation.copy(), position.copy()
        )
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], np.ravel(position)
        if T[2, 3] > 0.0:
            found.append((rms_px(T, view, board, camera), T))
    if not found:
        raise CalibrationError("bad_view", "no pose in front of the camera explains this view; is the camera right?")
    found.sort(key=lambda solution: solution[0])
    (error, T), (other_error, other) = found[0], found[-1]
    one = float(distance(T, other)[1]) < _SAME_DEG
    ambiguity = 0.0 if one else error / max(other_error, 1e-12)
    if ambiguity > AMBIGUOUS:
        raise CalibrationError(
            "ambiguous_pose",
            f"the board's tilt is ambiguous: {error:.2f} px and its mirror image {other_error:.2f} px; "
            "go nearer or look at the board more from the side.",
        )
    return BoardPose(T_camera_board=T, rms_px=error, ambiguity=ambiguity)


def check_view(view: BoardView, board: Board, camera: CameraModel) -> np.ndarray:
    """Return the corners (N, 3) of `view` in the board frame [m]; raises as `estimate_board_pose` does."""
    if view.image_size != camera.size:
        raise CalibrationError(
            "bad_view", f"an image of {view.image_size} px was given with a camera of {camera.size} px."
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
            "bad_view", f"a view has at least {MIN_CORNERS} corners with ids 0 … {len(corners) - 1}; got {view.ids}."
        )
    points = corners[view.ids]
    if np.linalg.matrix_rank(points - points.mean(axis=0), tol=0.1 * board.square_m) < 2:
        raise CalibrationError("bad_view", "all corners seen lie on one line; show more of the board.")
    return points


def rms_px(T_camera_board: np.ndarray, view: BoardView, board: Board, camera: CameraModel) -> float:
    """Return the root mean square distance between the corners seen and those projected [px]."""
    points = board.corners_m[view.ids] @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    return float(np.sqrt(np.mean(np.sum((camera.project(points) - view.pixels_px) ** 2, axis=1))))
