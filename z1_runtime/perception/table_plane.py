"""The table plane in the scene's cloud, with the depth noise that bounds the height of its points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.base.errors import InvalidValueError
from z1_runtime.perception.detector import NoTableError
from z1_runtime.perception.point_cloud import check_cloud
from z1_runtime.types import Plane


@dataclass(frozen=True, slots=True, kw_only=True)
class TableFit:
    """A table plane and its depth noise."""

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
    """Limits of the search for the table."""

    inlier_m: float = 0.008
    """Maximum distance of an inlier from a hypothesis [m]; about 3σ of the D405 at 0.5 m."""
    max_tilt_rad: float = 0.14
    """Maximum angle to the expected plane [rad]; excludes the face of a large box."""
    max_height_m: float = 0.05
    """Maximum distance of a considered point from the expected plane [m]; excludes tops of boxes."""
    n_hypotheses: int = 128
    """RANSAC draws; with 30 % inliers one is clean with 97 % probability."""
    n_points: int = 20_000
    """Maximum number of points in the fit, evenly chosen; 2 mm of noise on each leave about 0.02 mm."""
    min_inliers: int = 500
    """Minimum number of inliers of a table."""


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
    points = check_cloud(points)
    if (points[:, 2] <= 0).any():
        raise InvalidValueError(
            "the cloud has points behind the camera (z <= 0); give it in the camera frame.", code="behind_camera"
        )
    if hint is not None:
        # Bounds the time of the height test
        points = _thin(points, 3 * config.n_points)
        points = points[np.abs(hint.height_m(points)) < config.max_height_m]
    points = _thin(points, config.n_points)
    if len(points) < config.min_inliers:
        raise NoTableError(_no_table(len(points), config, "are near the expected table"))
    plane = _ransac(points, hint, config, seed)
    if plane is None:
        raise NoTableError(
            f"no plane within {config.max_tilt_rad} rad of the expected table; check that the camera sees the table "
            "and that the extrinsics are right.",
            code="table_tilt",
        )
    band = np.full(len(points), config.inlier_m)
    noise = 0.0
    for _ in range(3):  # the band follows the noise, and the fit follows the band: settled after two rounds
        inliers = np.abs(plane.height_m(points)) < band
        if inliers.sum() < config.min_inliers:
            raise NoTableError(_no_table(int(inliers.sum()), config, "are on the best plane"))
        plane = _least_squares(points[inliers])
        z2 = points[:, 2] ** 2
        # 1.4826 · median |r| is σ for Gaussian noise, and robust to the feet of objects inside the band.
        noise = 1.4826 * float(np.median(np.abs(plane.height_m(points[inliers])) / z2[inliers]))
        band = np.clip(3 * noise * z2, 0.25 * config.inlier_m, 3 * config.inlier_m)
    return TableFit(plane=plane, noise_per_m=noise)


def _thin(points: np.ndarray, n_max: int) -> np.ndarray:
    return points[:: -(-len(points) // n_max) or 1]


def _no_table(n: int, config: TableConfig, where: str) -> str:
    return (
        f"only {n} points {where}, {config.min_inliers} are needed; check that the camera sees the table and that the "
        "extrinsics are right."
    )


def _ransac(points: np.ndarray, hint: Plane | None, config: TableConfig, seed: int) -> Plane | None:
    rng = np.random.default_rng(seed)
    triples = points[rng.integers(len(points), size=(config.n_hypotheses, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=1)
    # Three points on a line span no plane
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
    # Bounds the residuals, one for each point and hypothesis
    sample = _thin(points, 2000)
    residual = sample @ normals.T - offsets
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
