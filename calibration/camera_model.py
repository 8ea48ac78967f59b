"""A pinhole camera with lens distortion, optical convention (x right, y down, z forward)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.errors import CalibrationError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraModel:
    """Projection of points in front of a camera to pixels; the centre of pixel (0, 0) is at 0.0.

    Raises:
        CalibrationError: `bad_camera`: wrong shapes, values that are not finite, or no focal length.
    """

    matrix: np.ndarray
    """(3, 3) camera matrix [px]."""
    distortion: np.ndarray
    """(5,) Brown-Conrady k1, k2, p1, p2, k3 as in OpenCV; zeros for an undistorted stream."""
    size: tuple[int, int]
    """Width and height of the image [px]."""

    def __post_init__(self) -> None:
        for name, shape in (("matrix", (3, 3)), ("distortion", (5,))):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != shape or not np.isfinite(array).all():
                raise CalibrationError(
                    f"camera {name}: the value is not a finite array of shape {shape}:\n{array}", code="bad_camera"
                )
            # A frozen dataclass does not keep an array's elements from being changed
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        width, height = self.size
        if min(width, height, self.matrix[0, 0], self.matrix[1, 1]) <= 0:
            raise CalibrationError(
                f"camera: focal lengths and size must be positive (matrix\n{self.matrix}\nsize {self.size}).",
                code="bad_camera",
            )
        object.__setattr__(self, "size", (int(width), int(height)))

    @classmethod
    def pinhole(cls, *, fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> CameraModel:
        """Return a camera without distortion from the fields of the HAL's `Intrinsics`."""
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return cls(matrix=matrix, distortion=np.zeros(5), size=(width, height))

    def project(self, points_m: np.ndarray) -> np.ndarray:
        """Return the pixels (..., 2) of points (..., 3) in the camera frame [m], z > 0."""
        return self.project_with_jacobian(points_m)[0]

    def project_with_jacobian(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (..., 2) of points (..., 3), and their Jacobian (..., 2, 3) by the point [px/m]."""
        k1, k2, p1, p2, k3 = self.distortion
        inverse_z = 1.0 / points_m[..., 2]
        x, y = points_m[..., 0] * inverse_z, points_m[..., 1] * inverse_z
        r2 = x * x + y * y
        # Brown-Conrady model as in OpenCV's calib3d: radial terms k, tangential terms p
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        d_radial = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))  # d radial / dx = x · d_radial
        distorted = np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=-1,
        )
        cross = x * y * d_radial + 2.0 * (p1 * x + p2 * y)
        d_distorted = np.empty((*x.shape, 2, 2))
        d_distorted[..., 0, 0] = radial + x * x * d_radial + 2.0 * p1 * y + 6.0 * p2 * x
        d_distorted[..., 0, 1] = d_distorted[..., 1, 0] = cross
        d_distorted[..., 1, 1] = radial + y * y * d_radial + 6.0 * p1 * y + 2.0 * p2 * x
        d_ray = np.zeros((*x.shape, 2, 3))
        d_ray[..., 0, 0] = d_ray[..., 1, 1] = inverse_z
        d_ray[..., 0, 2], d_ray[..., 1, 2] = -x * inverse_z, -y * inverse_z
        focal = self.matrix[:2, :2]
        return distorted @ focal.T + self.matrix[:2, 2], focal @ d_distorted @ d_ray

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for a JSON file."""
        return {"matrix": self.matrix.tolist(), "distortion": self.distortion.tolist(), "size": list(self.size)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> CameraModel:
        """Return the camera of `to_dict()`.

        Raises:
            CalibrationError: missing fields, wrong shapes, or values that are not finite.
        """
        try:
            width, height = values["size"]
            return cls(matrix=values["matrix"], distortion=values["distortion"], size=(width, height))
        except CalibrationError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise CalibrationError(
                f"camera: the fields cannot be used ({values}): {error!r}.", code="bad_camera"
            ) from error
