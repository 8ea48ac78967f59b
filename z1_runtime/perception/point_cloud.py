"""Point clouds from depth: back-projection and outlier filters, as pure functions.

Clouds are (N, 3) in the camera's optical frame [m] unless a docstring says otherwise. Filters return what to keep as
an (N,) bool, so that several can be chained without losing which pixel a point came from. Neighbour searches use
SciPy's KD-tree.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from hal.base.errors import InvalidValueError, Z1Error
from hal.base.messages import Intrinsics


class PerceptionError(Z1Error, RuntimeError):
    """Root of all errors of perception."""

    default_code = "perception"


def checked(points: np.ndarray) -> np.ndarray:
    """Return `points` as an array.

    Raises:
        ValueError: its shape is not (N, 3), or it is not finite.
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InvalidValueError(f"a cloud has shape (N, 3); got {points.shape}.")
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points).all(axis=1)).sum())
        raise InvalidValueError(f"{bad} of {len(points)} points are not finite; drop them before filtering.")
    return points


# --- Depth image to points ----------------------------------------------------------------------------------


def valid_pixels(depth_m: np.ndarray, d_max_m: float) -> np.ndarray:
    """Return the (H, W) bool pixels with 0 < d ≤ d_max; 0 is the camera's word for "no measurement"."""
    return (depth_m > 0) & (depth_m <= d_max_m)


def continuous_pixels(depth_m: np.ndarray, step_ratio: float = 0.03, min_neighbours: int = 3) -> np.ndarray:
    """Return the (H, W) bool pixels whose depth continues in at least `min_neighbours` of their 8 neighbours.

    Stereo interpolates between foreground and background at an edge; such flying pixels lie alone in between.
    Two depths continue each other when they differ by less than `step_ratio` of the smaller.
    """
    height, width = depth_m.shape
    count = np.zeros((height, width), np.uint8)
    tolerance = step_ratio * depth_m  # 0 where nothing was measured, so that a hole continues nobody
    everything, lower, upper = slice(None), slice(1, None), slice(None, -1)
    for rows_a, rows_b, columns_a, columns_b in (
        (everything, everything, lower, upper),
        (lower, upper, everything, everything),
        (lower, upper, lower, upper),
        (lower, upper, upper, lower),
    ):
        a, b = (rows_a, columns_a), (rows_b, columns_b)
        close = np.abs(depth_m[a] - depth_m[b]) < np.minimum(tolerance[a], tolerance[b])
        count[a] += close
        count[b] += close
    return count >= min_neighbours


def back_project(depth_m: np.ndarray, intrinsics: Intrinsics, pixels: np.ndarray) -> np.ndarray:
    """Return the (N, 3) points of the (H, W) bool `pixels`, row by row.

    Raises:
        ValueError: depth and pixels differ in shape.
    """
    if depth_m.shape != pixels.shape:
        raise InvalidValueError(f"depth {depth_m.shape} and pixels {pixels.shape} must have the same shape.")
    v, u = np.nonzero(pixels)
    return intrinsics.deproject(u, v, depth_m[pixels])


def box_pixels(shape: tuple[int, ...], box_px: tuple[int, int, int, int]) -> np.ndarray:
    """Return the (H, W) bool pixels inside `box_px` (u_min, v_min, u_max, v_max), upper ends exclusive."""
    u_min, v_min, u_max, v_max = (max(0, int(edge)) for edge in box_px)
    pixels = np.zeros(shape, bool)
    pixels[v_min:v_max, u_min:u_max] = True
    return pixels


def inside_box(points: np.ndarray, lower_m: np.ndarray, upper_m: np.ndarray) -> np.ndarray:
    """Return the (N,) bool points inside an axis-aligned box, in the frame of the points."""
    # Column by column: three short passes are quicker than one (N, 3) comparison reduced over its short axis.
    keep = np.ones(len(points), bool)
    for axis in range(3):
        keep &= (points[:, axis] >= lower_m[axis]) & (points[:, axis] <= upper_m[axis])
    return keep


# --- Filters ------------------------------------------------------------------------------------------------


def depth_clip(points: np.ndarray, low_percent: float = 1.0, high_percent: float = 99.0) -> np.ndarray:
    """Keep P_low(z) ≤ z ≤ P_high(z) (paper: 1 % and 99 % of the depths inside the crop)."""
    z = checked(points)[:, 2]
    if not len(z):
        return np.zeros(0, bool)
    low, high = np.percentile(z, [low_percent, high_percent])
    return (z >= low) & (z <= high)


def statistical_inliers(points: np.ndarray, k: int = 20, n_sigma: float = 2.0) -> np.ndarray:
    """Keep d̄_i ≤ μ + n_sigma · σ (paper: 2σ), d̄_i the mean distance to the k nearest other points.

    μ and σ are the mean and the standard deviation of all d̄_i. With k or fewer points nothing is dropped.
    """
    points = checked(points)
    if len(points) <= k:
        return np.ones(len(points), bool)
    distance, _ = KDTree(points).query(points, k=k + 1)
    mean = distance[:, 1:].mean(axis=1)  # column 0 is the point itself
    return mean <= mean.mean() + n_sigma * mean.std()


def radius_inliers(points: np.ndarray, radius_m: float = 0.01, min_neighbours: int = 10) -> np.ndarray:
    """Keep |{j ≠ i : ‖p_j − p_i‖ ≤ r}| ≥ min_neighbours."""
    points = checked(points)
    if len(points) <= min_neighbours:
        return np.zeros(len(points), bool)
    # At least m neighbours lie within r exactly if the m-th nearest does; one neighbour is cheaper than counting.
    bound = np.nextafter(radius_m, np.inf)
    distance, _ = KDTree(points).query(points, k=min_neighbours + 1, distance_upper_bound=bound)
    return distance[:, -1] <= radius_m


def subsample(points: np.ndarray, n_max: int, seed: int = 0) -> np.ndarray:
    """Return the indices, rising, of at most `n_max` points chosen evenly at random."""
    if len(points) <= n_max:
        return np.arange(len(points))
    return np.sort(np.random.default_rng(seed).choice(len(points), n_max, replace=False, shuffle=False))


def voxel_downsample(points: np.ndarray, size_m: float) -> np.ndarray:
    """Return the centroid of each occupied voxel floor(p / size_m), (M, 3), ordered by voxel."""
    points = checked(points)
    if not len(points):
        return points.astype(float)
    cells = np.floor(points / size_m).astype(np.int64)
    cells -= cells.min(axis=0)
    _, which, count = np.unique(
        np.ravel_multi_index(tuple(cells.T), cells.max(axis=0) + 1), return_inverse=True, return_counts=True
    )
    return np.column_stack([np.bincount(which, points[:, axis]) / count for axis in range(3)])
