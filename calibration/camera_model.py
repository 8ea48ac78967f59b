"""A pinhole camera with lens distortion, optical convention (x right, y down, z forward)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraModel:
    """What turns a point in front of the camera into a pixel; the centre of pixel (0, 0) is at 0.0."""

    matrix: np.ndarray
    """(3, 3) camera matrix [px]."""
    distortion: np.ndarray
    """(5,) Brown-Conrady k1, k2, p1, p2, k3 as in OpenCV; zeros for an undistorted stream."""
    size: tuple[int, int]
    """Width and height of the image [px]."""

    @classmethod
    def pinhole(cls, *, fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> CameraModel:
        """Return a camera without distortion from the fields of the HAL's `Intrinsics`."""
        raise NotImplementedError

    def project(self, points_m: np.ndarray) -> np.ndarray:
        """Return the pixels (..., 2) of points (..., 3) in the camera frame [m], z > 0."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for a JSON file."""
        raise NotImplementedError

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> CameraModel:
        """Return the camera of `to_dict()`.

        Raises:
            CalibrationError: missing fields, wrong shapes, or values that are not finite.
        """
        raise NotImplementedError
