"""Point clouds from depth: back-projection, outlier filters and the table plane, as pure functions.

Clouds are (N, 3) in the camera's optical frame [m] unless a docstring says otherwise. Filters return what to keep as
an (N,) bool, so that several can be chained without losing which pixel a point came from. Neighbour searches use
SciPy's KD-tree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from hal.messages import Intrinsics
from z1_runtime.types import Plane


class PerceptionError(RuntimeError):
    """Root of all errors of perception."""


class NoTableError(PerceptionError):
    """No table plane where one was expected."""


def _checked(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"a cloud has shape (N, 3); got {points.shape}.")
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points).all(axis=1)).sum())
        raise ValueError(f"{bad} of {len(points)} points are not finite; drop them before filtering.")
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

    Paper: x = (u − cx) z / fx, y = (v − cy) z / fy, z = d(u, v), with u the column and v the row.

    Raises:
        ValueError: depth and pixels differ in shape.
    """
    if depth_m.shape != pixels.shape:
        raise ValueError(f"depth {depth_m.shape} and pixels {pixels.shape} must have the same shape.")
    v, u = np.nonzero(pixels)
    z = depth_m[pixels].astype(float)
    points = np.empty((len(z), 3))
    points[:, 0] = (u - intrinsics.cx) * z / intrinsics.fx
    points[:, 1] = (v - intrinsics.cy) * z / intrinsics.fy
    points[:, 2] = z
    return points


def box_pixels(shape: tuple[int, ...], box_px: tuple[int, int, int, int]) -> np.ndarray:
    """Return the (H, W) bool pixels inside `box_px` (u_min, v_min, u_max, v_max), upper ends exclusive."""
    u_min, v_min, u_max, v_max = (max(0, int(edge)) for edge in box_px)
    pixels = np.zeros(shape, bool)
    pixels[v_min:v_max, u_min:u_max] = True
    return pixels


def transform(T_parent_child: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return `points` (N, 3), given in the child frame, in the parent frame."""
    return points @ T_parent_child[:3, :3].T + T_parent_child[:3, 3]


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
    z = _checked(points)[:, 2]
    if not len(z):
        return np.zeros(0, bool)
    low, high = np.percentile(z, [low_percent, high_percent])
    return (z >= low) & (z <= high)


def statistical_inliers(points: np.ndarray, k: int = 20, n_sigma: float = 2.0) -> np.ndarray:
    """Keep d̄_i ≤ μ + n_sigma · σ (paper: 2σ), d̄_i the mean distance to the k nearest other points.

    μ and σ are the mean and the standard deviation of all d̄_i. With k or fewer points nothing is dropped.
    """
    points = _checked(points)
    if len(points) <= k:
        return np.ones(len(points), bool)
    distance, _ = KDTree(points).query(points, k=k + 1)
    mean = distance[:, 1:].mean(axis=1)  # column 0 is the point itself
    return mean <= mean.mean() + n_sigma * mean.std()


def radius_inliers(points: np.ndarray, radius_m: float = 0.01, min_neighbours: int = 10) -> np.ndarray:
    """Keep |{j ≠ i : ‖p_j − p_i‖ ≤ r}| ≥ min_neighbours."""
    points = _checked(points)
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
    points = _checked(points)
    if not len(points):
        return points.astype(float)
    cells = np.floor(points / size_m).astype(np.int64)
    cells -= cells.min(axis=0)
    _, which, count = np.unique(
        np.ravel_multi_index(tuple(cells.T), cells.max(axis=0) + 1), return_inverse=True, return_counts=True
    )
    return np.column_stack([np.bincount(which, points[:, axis]) / count for axis in range(3)])


# --- The table ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class TableFit:
    """A table plane and how well the depth image knows it."""

    plane: Plane
    noise_per_m: float
    """Height noise of the table's points over depth squared [1/m]; stereo noise grows with z²."""

    def above(self, points: np.ndarray, min_height_m: float, n_sigma: float = 3.0) -> np.ndarray:
        """Return the (N,) bool points higher than max(min_height_m, n_sigma · noise_per_m · z²)."""
        return self.plane.height_m(points) > np.maximum(min_height_m, n_sigma * self.noise_per_m * points[:, 2] ** 2)


def expected_table(T_base_camera: np.ndarray) -> Plane:
    """Return the plane z = 0 of the base frame, in the camera frame."""
    return Plane(normal=T_base_camera[2, :3].copy(), offset_m=-float(T_base_camera[2, 3]))


@dataclass(frozen=True, slots=True, kw_only=True)
class TableConfig:
    """How the table is looked for."""

    inlier_m: float = 0.008
    """Distance to a hypothesis that counts as on it [m]; about 3σ of the D405 at 0.5 m."""
    max_tilt_rad: float = 0.14
    """Largest angle to the expected plane [rad]; keeps a big box's face from being called the table."""
    max_height_m: float = 0.05
    """Points further than this from the expected plane are not considered [m]; keeps out tops of boxes."""
    n_hypotheses: int = 128
    """RANSAC draws; with 30 % inliers one is clean with 97 % probability."""
    n_points: int = 20_000
    """Most points the plane is fitted to, evenly chosen; 2 mm of noise on each leave about 0.02 mm."""
    min_inliers: int = 500
    """Fewer of them on the plane are no table."""


def fit_table(
    points: np.ndarray, hint: Plane | None = None, config: TableConfig | None = None, seed: int = 0
) -> TableFit:
    """Find the table: seeded RANSAC, then least squares on the inliers; the normal points to the camera.

    RANSAC scores a hypothesis by Σ min(r², inlier²) (MSAC, Torr and Zisserman 2000). The least-squares fit weighs each
    point by 1/z⁴ because stereo noise is σ_z = z² σ_d / (f B).

    Args:
        points: (N, 3) the scene.
        hint: where the table is expected; without one the dominant plane is taken.
        config: search limits.
        seed: of the draws; the same seed gives the same plane.

    Raises:
        NoTableError: too few points near the expected plane, or too few on the best one.
        ValueError: points that are not finite or not in front of the camera.
    """
    config = config or TableConfig()
    points = _checked(points)
    if (points[:, 2] <= 0).any():
        raise ValueError("points of a camera lie in front of it (z > 0); is this cloud in another frame?")
    if hint is not None:
        points = _thinned(points, 3 * config.n_points)
        points = points[np.abs(hint.height_m(points)) < config.max_height_m]
    points = _thinned(points, config.n_points)
    if len(points) < config.min_inliers:
        raise NoTableError(_no_table(len(points), config, "were seen near where the table should be"))
    plane = _ransac(points, hint, config, seed)
    if plane is None:
        raise NoTableError(
            f"no plane within {config.max_tilt_rad} rad of the expected table; check that the camera sees the table "
            "and that the hand-eye transform fits the mount."
        )
    band = np.full(len(points), config.inlier_m)
    noise = 0.0
    for _ in range(3):  # the band follows the noise, and the fit follows the band: settled after two rounds
        inliers = np.abs(plane.height_m(points)) < band
        if inliers.sum() < config.min_inliers:
            raise NoTableError(_no_table(int(inliers.sum()), config, "lie on the best plane"))
        plane = _least_squares(points[inliers])
        z2 = points[:, 2] ** 2
        # 1.4826 · median |r| is σ for Gaussian noise, and deaf to the feet of objects inside the band.
        noise = 1.4826 * float(np.median(np.abs(plane.height_m(points[inliers])) / z2[inliers]))
        band = np.clip(3 * noise * z2, 0.25 * config.inlier_m, 3 * config.inlier_m)
    return TableFit(plane=plane, noise_per_m=noise)


def _thinned(points: np.ndarray, n_max: int) -> np.ndarray:
    return points[:: -(-len(points) // n_max) or 1]


def _no_table(n: int, config: TableConfig, where: str) -> str:
    return (
        f"only {n} points {where}, {config.min_inliers} are needed; check that the camera sees the table and that the "
        "hand-eye transform fits the mount."
    )


def _ransac(points: np.ndarray, hint: Plane | None, config: TableConfig, seed: int) -> Plane | None:
    rng = np.random.default_rng(seed)
    triples = points[rng.integers(len(points), size=(config.n_hypotheses, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-8
    triples, normals = triples[good], normals[good] / length[good, None]
    offsets = np.einsum("ij,ij->i", normals, triples[:, 0])
    # The camera is at the origin and above the table: n·0 − d > 0.
    flip = np.where(offsets > 0, -1.0, 1.0)
    normals, offsets = normals * flip[:, None], offsets * flip
    if hint is not None:
        near = normals @ hint.normal >= np.cos(config.max_tilt_rad)
        normals, offsets = normals[near], offsets[near]
    if not len(normals):
        return None
    judged = _thinned(points, 2000)
    residual = judged @ normals.T - offsets
    best = int(np.argmin(np.minimum(residual**2, config.inlier_m**2).sum(axis=0)))
    return Plane(normal=normals[best], offset_m=float(offsets[best]))


def _least_squares(points: np.ndarray) -> Plane:
    weights = points[:, 2] ** -4.0
    weights /= weights.sum()
    centre = weights @ points
    centred = points - centre
    _, vectors = np.linalg.eigh((centred * weights[:, None]).T @ centred)
    normal = vectors[:, 0]
    offset = float(normal @ centre)
    return Plane(normal=normal, offset_m=offset) if offset <= 0 else Plane(normal=-normal, offset_m=-offset)
