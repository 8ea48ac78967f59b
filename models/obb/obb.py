"""Oriented box around a cloud seen by one camera at the origin of the points' frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
