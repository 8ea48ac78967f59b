"""Detection of the board's corners in an image, to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from calibration.board.board import Board, make_opencv_board
from calibration.errors import CalibrationError, CalibrationWarning

MIN_CORNERS = 8
"""A view with fewer corners is rejected: a pose has six unknowns, and eight corners leave ten equations to spare."""
MIN_CORNER_RATIO = 0.6
"""A view with a smaller ratio of the board's corners gets the warning `partly_hidden`."""
BLURRED = 0.3
"""A view less sharp than this [1/px] gets the warning `blurred`; sharp ones have 0.5 and more."""
TOO_BLURRED = 0.18
"""A view less sharp than this is rejected."""

# rms distance between detected and projected corners in edges of a square; the corners of another board exceed it
_MAX_LAYOUT_ERROR = 0.15
# The largest dictionary of each size: OpenCV's smaller ones are the first entries of these
_OTHER_FAMILIES = ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_APRILTAG_36h11")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoardView:
    """The corners of the board in one image."""

    ids: np.ndarray
    """(N,) int, ascending indices into `Board.corners_m`."""
    pixels_px: np.ndarray
    """(N, 2) sub-pixel column and row; the centre of pixel (0, 0) is at 0.0."""
    sharpness: float
    """Maximum gradient across the board's edges over their contrast [1/px]: the inverse of an edge's width."""
    image_size: tuple[int, int]
    """Width and height of the image [px]."""
    warnings: tuple[CalibrationWarning, ...] = ()
    """`blurred`, `partly_hidden`: the view can be used, but should be improved."""


def detect_board(image: np.ndarray, board: Board) -> BoardView:
    """Return the corners of `board` in `image`, (H, W, 3) RGB or (H, W) grey, uint8.

    Raises:
        CalibrationError: `bad_image`; `no_board` (none in the image); `wrong_board` (markers or a pattern of another
            one); `hidden_board` (fewer than `MIN_CORNERS` corners); `blurred` (too blurred to use).
    """
    grey = _grey(image)
    ids, pixels = _find(grey, board)
    if len(ids) < MIN_CORNERS:
        raise _diagnose_failure(grey, board, len(ids))
    _check_layout(ids, pixels, board)
    sharpness = _sharpness(grey, ids, pixels, board)
    if sharpness < TOO_BLURRED:
        raise _blurred(f"its edges are {1 / sharpness:.0f} px wide, allowed up to {1 / TOO_BLURRED:.0f} px")
    return BoardView(
        ids=ids,
        pixels_px=pixels,
        sharpness=sharpness,
        image_size=(grey.shape[1], grey.shape[0]),
        warnings=tuple(_warnings(len(ids), len(board.corners_m), sharpness)),
    )


def _grey(image: np.ndarray) -> np.ndarray:
    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise CalibrationError(
            f"image: wrong shape or type ({image.shape} {image.dtype}, allowed (H, W, 3) or (H, W) uint8).",
            code="bad_image",
        )
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def _find(grey: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray]:
    """Return ids (N,) and pixels (N, 2); reshaped, as OpenCV 5 dropped an axis that 4 had."""
    corners, ids, _, _ = _detector(board).detectBoard(grey)
    if ids is None or corners is None:
        return np.zeros(0, int), np.zeros((0, 2))
    ids, corners = np.ravel(ids).astype(int), np.reshape(corners, (-1, 2)).astype(np.float64)
    order = np.argsort(ids)
    return ids[order], corners[order]


@lru_cache(maxsize=8)
def _detector(board: Board) -> Any:
    return cv2.aruco.CharucoDetector(make_opencv_board(board))


def _marker_ids(grey: np.ndarray, family: str) -> np.ndarray:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family))
    ids = cv2.aruco.ArucoDetector(dictionary).detectMarkers(grey)[1]
    return np.zeros(0, int) if ids is None else np.unique(np.ravel(ids))


def _diagnose_failure(grey: np.ndarray, board: Board, n_corners: int) -> CalibrationError:
    """Return the error with the cause of a failed detection: another board, blur, occlusion, or no board."""
    sharpness = _image_sharpness(grey)
    if sharpness < BLURRED:
        return _blurred(f"its edges are {1 / sharpness:.0f} px wide, its markers cannot be read")
    markers = _marker_ids(grey, board.dictionary)
    other = _other_board(grey, board, n_corners, markers)
    if other is not None:
        return _wrong(other)
    if n_corners >= MIN_CORNERS // 2 or len(markers) >= 2:
        return CalibrationError(
            f"board: too few corners detected ({n_corners}, needed from {MIN_CORNERS}). "
            "Uncover it, bring all of it into the image, and avoid reflections.",
            code="hidden_board",
        )
    return CalibrationError(
        "board: none detected. Bring it into the image, move nearer, add light, and let the arm come to rest.",
        code="no_board",
    )


def _other_board(grey: np.ndarray, board: Board, n_corners: int, markers: np.ndarray) -> str | None:
    """Return the evidence of another board in the image; None without any."""
    other = replace(board, legacy=not board.legacy)
    if len(_find(grey, other)[0]) >= MIN_CORNERS:
        return f"its markers are on the other colour, set `legacy` to {other.legacy}"
    own = board.columns * board.rows // 2
    # OpenCV numbers the markers of a board from 0 on
    if (markers >= own).any():
        return f"markers {markers[markers >= own].tolist()} were detected, the settings have 0 … {own - 1}"
    if len(markers) >= own / 2:
        return f"its markers are not arranged in {board.columns} columns and {board.rows} rows of squares"
    if n_corners == 0 and len(markers) < 2:
        for family in _OTHER_FAMILIES:
            found = _marker_ids(grey, family)
            # One marker may be a false positive in any image, three are not
            if len(found) >= 3 and family.rsplit("_", 1)[0] not in board.dictionary:
                return f"its markers are of {family.rsplit('_', 1)[0]}, not of {board.dictionary}"
    return None


def _check_layout(ids: np.ndarray, pixels: np.ndarray, board: Board) -> None:
    """Reject corners that do not fit a plane with this pattern: the print has other columns or rows than the board."""
    plane = board.corners_m[ids, :2].astype(np.float64)
    # Method 0 is least squares over all corners: a robust one would drop those that contradict the layout
    homography, _ = cv2.findHomography(plane, pixels, 0)
    if homography is None:
        raise CalibrationError(
            "board: all detected corners are on one line. Show more of the board.", code="hidden_board"
        )
    projected = cv2.perspectiveTransform(plane.reshape(-1, 1, 2), homography).reshape(-1, 2)
    error_px = float(np.sqrt(np.mean(np.sum((projected - pixels) ** 2, axis=1))))
    # The edge of a square in pixels, from the areas of the corners' hulls in both planes
    hulls = [cv2.contourArea(cv2.convexHull(np.float32(points).reshape(-1, 1, 2))) for points in (plane, pixels)]
    edge_px = board.square_m * np.sqrt(hulls[1] / max(hulls[0], 1e-12))
    if error_px > _MAX_LAYOUT_ERROR * edge_px:
        raise _wrong(f"its corners do not form {board.columns} columns and {board.rows} rows of squares")


def _sharpness(grey: np.ndarray, ids: np.ndarray, pixels: np.ndarray, board: Board) -> float:
    """Return the maximum gradient over the contrast across the squares' edges [1/px], in the blurrier direction.

    Edges along x and along y are measured separately, since motion blurs only those across it.
    """
    positions = {corner: pixel for corner, pixel in zip(ids.tolist(), pixels, strict=True)}
    row_length = board.columns - 1
    gradients = []
    for step in (1, row_length):
        pairs = [
            (positions[corner], positions[corner + step])
            for corner in positions
            if corner + step in positions and (step > 1 or corner % row_length < row_length - 1)
        ]
        if pairs:
            gradients.append(_edge_gradient(grey, np.array(pairs)))
    return min(gradients) if gradients else 0.0


def _edge_gradient(grey: np.ndarray, ends: np.ndarray) -> float:
    """Return the median gradient over contrast [1/px] across edges with `ends` (E, 2, 2) [px]."""
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / length
    reach = np.clip(0.35 * np.median(length), 3.0, 12.0)
    # Four samples a pixel, so that the difference over four of them below is one over a pixel
    offsets = np.linspace(-reach, reach, int(2 * reach) * 4 + 1)
    # Only the middle of an edge: at both ends another edge crosses it
    middles = ends[:, 0, None] + along[:, None] * np.array([0.3, 0.4, 0.5, 0.6, 0.7])[:, None]  # (E, 5, 2)
    at = middles[:, :, None] + across[:, None, None] * offsets[:, None]  # (E, 5, K, 2)
    at = at.reshape(len(ends), -1, 2).astype(np.float32)
    lines = cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    profile = lines.reshape(len(ends), 5, -1).astype(np.float64).mean(axis=1)  # (E, K): the mean reduces the noise
    # Over one pixel: a finer difference would only measure the interpolation
    gradient = np.abs(profile[:, 4:] - profile[:, :-4]) / (4 * (offsets[1] - offsets[0]))
    contrast = np.maximum(np.ptp(profile, axis=1), 1.0)
    return float(np.median(gradient.max(axis=1) / contrast))


def _image_sharpness(grey: np.ndarray) -> float:
    """Return the same measure for an image without a detected board, from its strongest edges.

    An image without strong edges gives 1: it is empty, not blurred.
    """
    window = np.ones((13, 13), np.uint8)
    contrast = cv2.dilate(grey, window).astype(np.float32) - cv2.erode(grey, window)
    strong = contrast > 80.0
    if strong.mean() < 0.01:
        return 1.0
    found = []
    for dx, dy in ((1, 0), (0, 1)):
        gradient = np.abs(cv2.Sobel(grey, cv2.CV_32F, dx, dy, ksize=3)) / 8.0  # the kernel's weights sum to 8
        found.append(float(np.percentile(cv2.dilate(gradient, window)[strong] / contrast[strong], 90)))
    return min(found)


def _warnings(n_detected: int, n_corners: int, sharpness: float) -> list[CalibrationWarning]:
    found = []
    if n_detected < MIN_CORNER_RATIO * n_corners:
        message = (
            f"board: {n_detected} of {n_corners} corners were detected; the rest is occluded, in a reflection, or "
            "outside."
        )
        found.append(CalibrationWarning(code="partly_hidden", message=message))
    if sharpness < BLURRED:
        message = (
            f"board: its edges are {1 / sharpness:.1f} px wide, up to {1 / BLURRED:.0f} px is good. Let the arm "
            "come to "
            "rest, add light for a shorter exposure, or increase the distance."
        )
        found.append(CalibrationWarning(code="blurred", message=message))
    return found


def _wrong(what: str) -> CalibrationError:
    return CalibrationError(f"board: another one than in the settings: {what}.", code="wrong_board")


def _blurred(what: str) -> CalibrationError:
    return CalibrationError(
        f"board: blurred, {what}. Let the arm come to rest, add light, or increase the distance.", code="blurred"
    )
