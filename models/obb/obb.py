"""Oriented box around a cloud seen by one camera at the origin of its frame, and three ways to choose its axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from hal.base.errors import InvalidValueError, Z1Error

FACE_AXES = np.array([0, 0, 1, 1, 2, 2])
"""(6,) box axis of each face; the faces are ordered +x, −x, +y, −y, +z, −z."""
FACE_SIGNS = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
"""(6,) direction of each face's outward normal along its axis."""


class DegenerateCloudError(Z1Error, ValueError):
    """Cloud that spans no box: too few points, on one line, all in one place, or not finite."""

    default_code = "degenerate_cloud"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OrientedBox:
    """Right-handed oriented box; faces are ordered +x, −x, +y, −y, +z, −z."""

    T_camera_box: np.ndarray
    """(4, 4) pose of the box's centre; the columns of its rotation are the box's axes."""
    half_extents_m: np.ndarray
    """(3,) half the edge lengths along those axes [m]."""
    unobserved: np.ndarray
    """(3,) bool, true for the axis along the view when only the face across it is visible: that extent is then
    the visible depth (noise on a flat face, half the depth of a round one), not the object's."""

    def __post_init__(self) -> None:
        shapes = (self.T_camera_box.shape, self.half_extents_m.shape, self.unobserved.shape)
        if shapes != ((4, 4), (3,), (3,)):
            raise InvalidValueError(f"OrientedBox takes (4, 4), (3,), (3,); got {shapes}.", code="shape")
        # `frozen` does not protect the content of arrays, which several stages share
        for array in (self.T_camera_box, self.half_extents_m, self.unobserved):
            array.setflags(write=False)

    @property
    def center_m(self) -> np.ndarray:
        """(3,) centre in the camera frame [m]."""
        return self.T_camera_box[:3, 3]

    @property
    def R_camera_box(self) -> np.ndarray:
        """(3, 3) rotation; its columns are the box's axes in the camera frame."""
        return self.T_camera_box[:3, :3]

    @property
    def extents_m(self) -> np.ndarray:
        """(3,) edge lengths [m]."""
        return 2.0 * self.half_extents_m

    @property
    def volume_m3(self) -> float:
        """Volume [m³]."""
        return float(np.prod(self.extents_m))

    @property
    def face_normals(self) -> np.ndarray:
        """(6, 3) outward unit normals in the camera frame."""
        return self.R_camera_box.T[FACE_AXES] * FACE_SIGNS[:, None]

    @property
    def face_centers_m(self) -> np.ndarray:
        """(6, 3) centres of the faces in the camera frame, half an edge from the box's centre [m]."""
        return self.center_m + self.face_normals * self.half_extents_m[FACE_AXES, None]

    @property
    def corners_m(self) -> np.ndarray:
        """(8, 3) corners in the camera frame, z fastest, from (−, −, −) to (+, +, +) [m]."""
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, 8).T
        return self.center_m + (signs * self.half_extents_m) @ self.R_camera_box.T


_YAW_BINS = 90  # Zhang et al. 2017 search the quarter turn in steps of 1°
_CLOSENESS_D0_M = 1.5e-3  # about two sigma of the camera's depth noise: nearer points count as on the edge
_COARSE_CELL_M = 5e-3  # for the search over the whole quarter turn
_FINE_CELL_M = 2e-3  # for its refinement to 0.125°
_MAX_CELLS_PER_SIDE = 500
_ROUND_CONTRAST = 0.7  # median over best closeness: ≤ 0.63 on boxes, ≥ 0.76 on cylinders of 40–84 mm and a bottle
_PLATEAU = 0.99
_PLANAR_M = 1e-4  # thinner clouds have no hull in three dimensions that Qhull can build
_MAX_HULL_DIRECTIONS = 48


def principal_axes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard deviations (3,) [m], largest first, and the axes (3, 3) of `points` (N, 3): the paper's."""
    centered = points - points.mean(axis=0)
    variances, axes = np.linalg.eigh(centered.T @ centered / len(points))
    return np.sqrt(np.maximum(variances[::-1], 0.0)), axes[:, ::-1]


def min_volume_axes(points: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the axes (3, 3) of a minimum-volume box with a face flush with the convex hull of `points` (N, 3).

    The largest facets of the hull are tried as a face, the rectangle in each found by rotating calipers
    (the minimum-area rectangle has a side on an edge of the hull); the best is refined about its other axes.

    Args:
        points: (N, 3) [m].
        axes: (3, 3) the principal axes of `points`; for a planar cloud the last is the box's normal.
    """
    if np.ptp(points @ axes[:, 2]) < _PLANAR_M:
        return _turn_by_calipers(points, axes[:, 2])[0]
    hull = ConvexHull(points)
    vertices = points[hull.vertices]
    candidates = (_turn_by_calipers(vertices, normal) for normal in _large_facet_normals(points, hull))
    best, volume = min(candidates, key=lambda candidate: candidate[1])
    for _ in range(4):
        trials = (_turn_by_calipers(vertices, best[:, axis]) for axis in range(3))
        axes, polished = min(trials, key=lambda candidate: candidate[1])
        if polished >= volume * (1.0 - 1e-9):
            break
        best, volume = axes, polished
    return best


def upright_axes(points: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return axes (3, 3) with z along `up` and the yaw of the L-shape closeness fit to the footprint of `points`.

    Zhang et al. 2017, "Efficient L-Shape Fitting for Vehicle Detection Using Laser Scanners", algorithm 4: the
    yaw whose rectangle has most points close to its two occupied sides. A minimum-area rectangle follows the
    hypotenuse of the L that two visible side faces make; this one follows the faces. A round footprint prefers no
    yaw: its box faces the camera.

    Args:
        points: (N, 3) [m].
        up: (3,) unit vector against gravity in the same frame.
    """
    frame = _frame_with_z(up)
    flat = frame[:, :2].T @ points.T  # (2, N): contiguous rows are twice as fast here
    cells, weights = _cell_means(flat, np.ones(len(points)), _FINE_CELL_M)
    coarse = np.arange(_YAW_BINS) * (np.pi / 2 / _YAW_BINS)
    closeness = _closeness(*_cell_means(cells, weights, _COARSE_CELL_M), coarse)
    if np.median(closeness) > _ROUND_CONTRAST * closeness.max():
        yaw = np.arctan2(*flat.mean(axis=1)[::-1])
    else:
        fine = coarse[np.argmax(closeness)] + np.deg2rad(np.arange(-12, 13) * 0.125)
        closeness = _closeness(cells, weights, fine)
        # Below d0 all yaws count alike: the middle of the best plateau, not its first yaw.
        yaw = fine[closeness >= _PLATEAU * closeness.max()].mean()
    c, s = np.cos(yaw), np.sin(yaw)
    return frame @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _closeness(footprint: np.ndarray, weights: np.ndarray, yaws_rad: np.ndarray) -> np.ndarray:
    """Return for each yaw (K,) the sum over points (2, M) of weight / max(distance to the occupied sides, d0)."""
    c, s = np.cos(yaws_rad).astype(np.float32), np.sin(yaws_rad).astype(np.float32)
    footprint, weights = footprint.astype(np.float32), weights.astype(np.float32)
    distances = []
    for direction in (np.stack([c, s]), np.stack([-s, c])):  # (2, K) each
        along = direction.T @ footprint  # (K, M)
        # Percentile bounds, not extremes: one flying pixel must not shift a side.
        ends = _row_percentiles(along, (1.0, 99.0))
        to_low, to_high = np.abs(along - ends[0][:, None]), np.abs(ends[1][:, None] - along)
        low_is_occupied = (to_low @ weights <= to_high @ weights)[:, None]
        distances.append(np.where(low_is_occupied, to_low, to_high))
    return (1.0 / np.maximum(np.minimum(*distances), _CLOSENESS_D0_M)) @ weights


def _row_percentiles(rows: np.ndarray, percentile: tuple[float, float]) -> np.ndarray:
    """Return the two nearest-rank percentiles (2, K) of each row of (K, M): `np.percentile` without its overhead."""
    last = rows.shape[1] - 1
    ranks = [round(last * p / 100.0) for p in percentile]
    return np.partition(rows, ranks, axis=1)[:, ranks].T


def _cell_means(flat: np.ndarray, weights: np.ndarray, cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Merge points (2, N) that share a cell: mean positions (2, M) and summed weights (M,), in any order of points."""
    low = flat.min(axis=1, keepdims=True)
    span = (flat.max(axis=1, keepdims=True) - low).ravel()
    cell_m = max(cell_m, float(span.max()) / _MAX_CELLS_PER_SIDE)
    columns, rows = ((flat - low) / cell_m).astype(np.int64)
    keys = columns * (int(span[1] / cell_m) + 2) + rows
    sums = np.bincount(keys, weights)
    filled = np.flatnonzero(sums)
    means = np.stack([np.bincount(keys, row * weights)[filled] for row in flat]) / sums[filled]
    return means, sums[filled]


def _large_facet_normals(points: np.ndarray, hull: ConvexHull) -> np.ndarray:
    """Return the normals (F, 3) of the hull's largest triangles, largest first."""
    corners = points[hull.simplices]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return hull.equations[np.argsort(-areas, kind="stable")[:_MAX_HULL_DIRECTIONS], :3]


def _turn_by_calipers(points: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, float]:
    """Return axes (3, 3) with z along `normal` and the minimum-area rectangle across it, and the box's volume."""
    frame = _frame_with_z(normal)
    flat = points @ frame[:, :2]
    rim = flat[ConvexHull(flat).vertices]
    edges = np.roll(rim, -1, axis=0) - rim
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    across = np.stack([-edges[:, 1], edges[:, 0]], axis=1)
    areas = np.ptp(rim @ edges.T, axis=0) * np.ptp(rim @ across.T, axis=0)
    best = int(np.argmin(areas))
    x_axis, y_axis = frame[:, :2] @ edges[best], frame[:, :2] @ across[best]
    return np.stack([x_axis, y_axis, normal], axis=1), float(areas[best] * max(np.ptp(points @ normal), _PLANAR_M))


def _frame_with_z(z_axis: np.ndarray) -> np.ndarray:
    """Return a right-handed frame (3, 3) whose third column is `z_axis` (unit)."""
    helper = np.eye(3)[np.argmin(np.abs(z_axis))]
    x_axis = np.cross(helper, z_axis)
    x_axis /= np.linalg.norm(x_axis)
    return np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], axis=1)
