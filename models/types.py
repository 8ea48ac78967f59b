"""Data between the models, all in the camera's optical frame (x right, y down, z forward)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from hal.base.errors import InvalidValueError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraspSet:
    """Candidate grasps of a parallel jaw, in the paper's grasp frame.

    z is the approach, y runs along the finger opening, the origin is midway between the fingertips.
    """

    T_camera_grasps: np.ndarray
    """(N, 4, 4) grasp poses."""
    scores: np.ndarray
    """(N,) confidence in [0, 1]."""
    widths_m: np.ndarray
    """(N,) distance between the two contacts along y [m]; NaN where the generator gives none."""
    source: str = ""
    """Name of the generator that proposed them."""

    def __post_init__(self) -> None:
        n = len(self.T_camera_grasps)
        if self.T_camera_grasps.shape != (n, 4, 4) or self.scores.shape != (n,) or self.widths_m.shape != (n,):
            raise InvalidValueError(
                f"GraspSet wants (N, 4, 4), (N,), (N,); got {self.T_camera_grasps.shape}, "
                f"{self.scores.shape}, {self.widths_m.shape}.",
                code="shape",
            )
        for array in (self.T_camera_grasps, self.scores, self.widths_m):
            array.setflags(write=False)

    def __len__(self) -> int:
        return len(self.scores)

    def __getitem__(self, index: np.ndarray | slice) -> GraspSet:
        """Return the grasps at `index` (a slice, a mask or an array of indices), in its order."""
        return GraspSet(
            T_camera_grasps=self.T_camera_grasps[index],
            scores=self.scores[index],
            widths_m=self.widths_m[index],
            source=self.source,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Detection:
    """One object found in an image."""

    label: str
    """Class name."""
    confidence: float
    """In [0, 1]."""
    box_px: tuple[int, int, int, int]
    """(u_min, v_min, u_max, v_max), the upper ends exclusive [px]."""
    mask: np.ndarray | None = field(default=None)
    """(H, W) bool, the object's pixels, where the detector gives masks."""


class GraspGenerator(Protocol):
    """Source of grasp candidates for an object's points; independent of arm, table and gravity."""

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return `n` grasps in the frame of `points` (M, 3) [m]; the same seed gives the same grasps.

        Raises:
            InvalidValueError: too few points, or points that are not finite.
        """
        ...


MIN_CLOUD_POINTS = 30
"""Minimum number of points for a grasp generator: the neighbourhood of one normal (`models.samplers.surfels`)."""


def check_request(points: np.ndarray, n: int) -> np.ndarray:
    """Return `points` as float64 (M, 3), valid for a request of `n` grasps.

    Raises:
        InvalidValueError: `n` is below one, too few points, another shape, or points that are not finite.
    """
    points = np.asarray(points, dtype=np.float64)
    if n < 1:
        raise InvalidValueError(f"Asked for {n} grasps; ask for one or more.", code="grasp_count")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < MIN_CLOUD_POINTS:
        raise InvalidValueError(
            f"Grasps need a cloud (M, 3) of {MIN_CLOUD_POINTS} points or more; got {points.shape}.", code="cloud_points"
        )
    if not np.isfinite(points).all():
        raise InvalidValueError(
            "The cloud holds points that are NaN or infinite; drop invalid depth first.", code="cloud_not_finite"
        )
    return points


MAX_OBJECT_M = 1.0
"""Longest side of one object's cloud [m]; a cloud in millimetres is far above."""
MIN_OBJECT_M = 0.002
"""Points nearer together than this show no shape [m]."""


def check_object_cloud(points: np.ndarray, n: int) -> np.ndarray:
    """Return `points` as float64 (M, 3), valid as one object's cloud in metres for a request of `n` grasps.

    Raises:
        InvalidValueError: as `check_request`; also points all in one place, or not in metres.
    """
    points = check_request(points, n)
    extent = float(np.ptp(points, axis=0).max())
    if not MIN_OBJECT_M < extent < MAX_OBJECT_M:
        raise InvalidValueError(
            f"The cloud spans {extent:.4g} m; allowed is {MIN_OBJECT_M} to {MAX_OBJECT_M} m. "
            "Give one object's points, in metres (not millimetres).",
            code="cloud_extent",
        )
    return points
