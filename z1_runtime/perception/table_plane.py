"""The table under the object: found in the scene's cloud, with the noise that says how far up it reaches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.base.errors import InvalidValueError
from z1_runtime.perception.point_cloud import PerceptionError, checked
from z1_runtime.types import Plane


class NoTableError(PerceptionError):
    """No table plane where one was expected."""


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
    points = checked(points)
    if (points[:, 2] <= 0).any():
        raise InvalidValueError("points of a camera lie in front of it (z > 0); is this cloud in another frame?")
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
