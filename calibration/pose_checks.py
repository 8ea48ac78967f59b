"""Poses of a calibration: validation of those given, and their differences in the units of a report."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.errors import CalibrationError
from hal.base.transforms import pose_distances

# Looser than hal.base.transforms.check_pose: poses come from files of other programs, with four or five digits
_ORTHONORMAL_ATOL = 1e-4


def pose_distances_mm_deg(Ts_parent_a: np.ndarray, Ts_parent_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances [mm] and angles [°] between poses (..., 4, 4), which may broadcast."""
    distances_m, angles_rad = pose_distances(Ts_parent_a, Ts_parent_b)
    return 1e3 * distances_m, np.degrees(angles_rad)


def check_poses(Ts: np.ndarray, name: str) -> np.ndarray:
    """Return `Ts` as float64 (N, 4, 4) with exactly orthonormal rotations.

    Raises:
        CalibrationError: `bad_poses`: wrong shape, values that are not finite, or no rigid transforms.
    """
    Ts = np.array(Ts, dtype=np.float64)
    if Ts.ndim != 3 or Ts.shape[1:] != (4, 4):
        raise CalibrationError(f"{name}: shape is {Ts.shape}, allowed is (N, 4, 4).", code="bad_poses")
    R = Ts[:, :3, :3]
    # Values that are not finite are rejected below, without NumPy's warnings
    with np.errstate(invalid="ignore"):
        deviations = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        good = np.isfinite(Ts).all(axis=(1, 2)) & (deviations < _ORTHONORMAL_ATOL) & (np.linalg.det(R) > 0.0)
        good &= np.abs(Ts[:, 3] - (0.0, 0.0, 0.0, 1.0)).max(axis=1, initial=0.0) < 1e-6
    if not good.all():
        bad = int(np.flatnonzero(~good)[0])
        raise CalibrationError(f"{name}[{bad}]: the matrix is no rigid transform:\n{Ts[bad]}", code="bad_poses")
    if len(Ts):
        # SciPy makes the matrices orthonormal: a file's rounded digits would accumulate in products
        Ts[:, :3, :3] = Rotation.from_matrix(R).as_matrix()
    return Ts
