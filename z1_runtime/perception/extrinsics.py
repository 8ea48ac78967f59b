"""Extrinsics of the wrist camera: from its calibration or the mount's drawing, and checked by the robot's own jaws.

The jaws are always in the picture and of known shape. Extrinsics that are off by 3 mm and 1° show an object 0.4 m away
up to 10 mm off its place: too far for a grasp. The jaws' depth, registered to their meshes by iterative closest points
(point to plane), recovers that place to 0.8 mm on average, 2.2 mm at worst (21 frames in the twin, by
scripts/measure/measure_extrinsics_check.py), so that a camera that was knocked is compensated.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hal.base import z1
from hal.base.errors import ConfigError, InvalidValueError
from hal.base.messages import RgbdFrame
from hal.base.transforms import inverse, transform_points
from hal.base.z1 import T_FLANGE_STATIONARY_JAW, moving_jaw_pose

if TYPE_CHECKING:
    from calibration.results import CalibrationResult


FOLDER_VARIABLE = "Z1_CALIBRATIONS"
"""Environment variable with the folder of the results."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Extrinsics:
    """The hand-eye transform in force and its origin."""

    T_flange_camera: np.ndarray
    """(4, 4)."""
    origin: str
    """One line for the operator: file, date and uncertainty; or why the drawing's figures are taken."""


def results_folder(given: Path | None = None) -> Path:
    """Return the folder of results: `given`, else $Z1_CALIBRATIONS, else z1-grasp/calibrations in the user's data."""
    if given is not None:
        return given
    if named := os.environ.get(FOLDER_VARIABLE):
        return Path(named)
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "z1-grasp" / "calibrations"


def find_extrinsics(serial: str, file: Path | None = None, folder: Path | None = None) -> Extrinsics:
    """Return the extrinsics of the camera `serial`; quality warnings are logged.

    Args:
        serial: of the camera; empty without one, which then has no calibration of its own.
        file: the result to use; None takes the newest valid one of this camera, or the drawing where there is none.
        folder: folder of the results, as in `results_folder`.

    Raises:
        ConfigError: `file` is missing or damaged, of another camera, or no hand-eye result of a wrist camera.
    """
    folder = results_folder(folder)
    if file is None and not (folder.is_dir() and any(folder.iterdir())):
        return _nominal(serial, folder)
    from calibration.errors import CalibrationError  # OpenCV's calibration is needed only where there is a result
    from calibration.results import load_newest, load_result

    try:
        found = load_result(file, serial=serial) if file is not None else load_newest(folder, "hand_eye", serial)
        T_flange_camera = found.T_flange_camera
    except CalibrationError as error:
        # Only an absent result falls back to the drawing: a damaged one must not pass unnoticed
        if file is None and error.code == "missing_result":
            return _nominal(serial, folder)
        raise ConfigError(str(error), code=error.code) from error
    return Extrinsics(T_flange_camera=T_flange_camera, origin=_origin(found))


def _nominal(serial: str, folder: Path) -> Extrinsics:
    whose = f"of camera {serial}" if serial else "of this camera, which has no serial number,"
    return Extrinsics(
        T_flange_camera=z1.T_FLANGE_CAMERA,
        origin=f"the mount's drawing (no hand-eye calibration {whose} in {folder})",
    )


def _origin(found: CalibrationResult) -> str:
    errors = found.errors
    return (
        f"{found.path}, camera {found.serial}, {found.date}, "
        f"±{errors['uncertainty_mm']:.2f} mm ±{errors['uncertainty_deg']:.3f}°"
    )


_SAMPLES = {"z1_GripperStator": 50_000, "z1_GripperMover": 30_000}
_ROUNDS, _FIRST_GATE_M, _LAST_GATE_M, _GATE_RATIO = 20, 0.012, 0.002, 0.75
_CONVERGED = 1e-4  # largest entry of a step: rad, and metres
_COARSE_STRIDE = 4  # every fourth point is enough until the gate is at its last size
_CAUCHY_M = 0.001  # residuals beyond it weigh ever less (Cauchy weights)
_MIN_POINTS = 300
_RANGE_M = 0.4  # distance of an object from the lens at which an error of the extrinsics is measured


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtrinsicsCheck:
    """Conditions under which the extrinsics that the jaws show replace the given ones."""

    enabled: bool = True
    """Whether the check is done at all."""
    min_correction_m: float = 0.002
    """Minimum correction, measured 0.4 m ahead of the lens; below it the given extrinsics stay [m]."""
    max_correction_m: float = 0.020
    """Maximum correction; above it something other than the jaws is in view, and the given extrinsics stay [m]."""
    min_inlier_ratio: float = 0.8
    """Minimum ratio of the jaws' pixels that are within 2 mm of their meshes."""
    max_rms_m: float = 0.0006
    """Maximum root mean square distance of those from the meshes [m]; jaws of another make do not fit as closely."""
    points: int = 4000
    """Number of pixels that are registered."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.min_correction_m < self.max_correction_m < 0.1:
            raise InvalidValueError(
                f"min_correction_m and max_correction_m are {self.min_correction_m} and {self.max_correction_m}; "
                "allowed is 0 <= min < max < 0.1 m.",
                code="correction",
            )
        if not 0.0 < self.min_inlier_ratio <= 1.0:
            raise InvalidValueError(
                f"min_inlier_ratio is {self.min_inlier_ratio}; allowed is above 0 up to 1.", code="min_inlier_ratio"
            )
        if not 0.0 < self.max_rms_m < 0.01:
            raise InvalidValueError(
                f"max_rms_m is {self.max_rms_m}; allowed is above 0, below 0.01 m.", code="max_rms_m"
            )
        if self.points < _MIN_POINTS:
            raise InvalidValueError(f"points is {self.points}; allowed is {_MIN_POINTS} or more.", code="points")

    def correct(
        self, frame: RgbdFrame, gripper: np.ndarray, jaw: float, T_flange_camera: np.ndarray
    ) -> ExtrinsicsEstimate | None:
        """Return the extrinsics that the jaws show, where they are reliable and differ from the given ones; else None.

        Args:
            frame: with the depth of the jaws.
            gripper: (H, W) bool, the pixels that may show them (`SelfFilter.gripper_pixels`).
            jaw: jaw angle when the frame was taken [rad].
            T_flange_camera: (4, 4) extrinsics as far as they are known.
        """
        estimate = self.estimate(frame, gripper, jaw, T_flange_camera) if self.enabled else None
        if estimate is None or estimate.inlier_ratio < self.min_inlier_ratio or estimate.rms_m > self.max_rms_m:
            return None
        return estimate if self.min_correction_m < estimate.correction_m < self.max_correction_m else None

    def estimate(
        self, frame: RgbdFrame, gripper: np.ndarray, jaw: float, T_flange_camera: np.ndarray
    ) -> ExtrinsicsEstimate | None:
        """Return the extrinsics that register the jaws' depth to their meshes; None with too few pixels of them.

        Arguments as in `correct`.
        """
        points = self._jaw_points(frame, gripper)
        if len(points) < _MIN_POINTS:
            return None
        surface, normals = _jaw_surface(jaw)
        lens = T_flange_camera[:3, 3]
        # Only faces turned to the lens can be in its picture
        facing = np.einsum("ij,ij->i", surface - lens, normals) < 0.0
        surface, normals = surface[facing], normals[facing]
        tree, T = cKDTree(surface), T_flange_camera.copy()
        inliers, residuals = np.zeros(0, dtype=bool), np.zeros(0)
        for number in range(_ROUNDS):
            gate = max(_FIRST_GATE_M * _GATE_RATIO**number, _LAST_GATE_M)
            at = transform_points(T, points if gate == _LAST_GATE_M else points[::_COARSE_STRIDE])
            distances, nearest = tree.query(at, distance_upper_bound=gate)
            inliers = np.isfinite(distances)
            n, at = normals[nearest[inliers]], at[inliers]
            residuals = np.einsum("ij,ij->i", at - surface[nearest[inliers]], n)
            step = _point_to_plane_step(at, n, residuals)
            T = step @ T
            if gate == _LAST_GATE_M and np.abs(step - np.eye(4)).max() < _CONVERGED:
                break
        ahead = np.array([0.0, 0.0, _RANGE_M])
        return ExtrinsicsEstimate(
            T_flange_camera=T,
            correction_m=float(np.linalg.norm(transform_points(inverse(T_flange_camera) @ T, ahead[None])[0] - ahead)),
            inlier_ratio=float(inliers.mean()),
            rms_m=float(np.sqrt(np.mean(residuals**2))) if len(residuals) else np.inf,
        )

    def _jaw_points(self, frame: RgbdFrame, gripper: np.ndarray) -> np.ndarray:
        """Return at most `points` points (N, 3) in the camera frame that may show the jaws [m]."""
        v, u = np.nonzero(gripper)
        chosen = np.random.default_rng(0).permutation(len(u))[: self.points]
        u, v = u[chosen], v[chosen]
        return frame.intrinsics.deproject(u, v, frame.depth_m[v, u])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExtrinsicsEstimate:
    """The extrinsics that the jaws show."""

    T_flange_camera: np.ndarray
    """(4, 4)."""
    correction_m: float
    """Distance by which a point 0.4 m ahead of the lens moves against the given extrinsics [m]."""
    inlier_ratio: float
    """Ratio of the pixels that are on the meshes within 2 mm."""
    rms_m: float
    """Root mean square distance of those from the meshes [m]."""


def warm_up_extrinsics_check() -> None:
    """Load and sample the meshes, so that the first frame is as fast as the next."""
    _jaw_surface(z1.GRIPPER_CLOSED)


def _point_to_plane_step(at: np.ndarray, normals: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Return the small motion (4, 4) of points (N, 3) that reduces their distances `residuals` (N,) to planes most."""
    weights = 1.0 / (1.0 + (residuals / _CAUCHY_M) ** 2)
    jacobian = np.column_stack([normals, np.cross(at, normals)])
    weighted = jacobian * weights[:, None]
    # The diagonal keeps directions finite that the matched faces leave free
    x = np.linalg.solve(weighted.T @ jacobian + 1e-6 * np.eye(6), -weighted.T @ residuals)
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = Rotation.from_rotvec(x[3:]).as_matrix(), x[:3]
    return step


def _jaw_surface(jaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Return surface points (N, 3) [m] and outward normals (N, 3) of both jaws in the flange frame."""
    (fixed, fixed_normals), (moving, moving_normals) = (_sample_mesh(name) for name in _SAMPLES)
    T_fixed, T_moving = T_FLANGE_STATIONARY_JAW, z1.T_FLANGE_PIVOT @ moving_jaw_pose(jaw)
    points = [transform_points(T_fixed, fixed), transform_points(T_moving, moving)]
    return np.concatenate(points), np.concatenate(
        [fixed_normals @ T_fixed[:3, :3].T, moving_normals @ T_moving[:3, :3].T]
    )


@cache
def _sample_mesh(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return random surface points (N, 3) [m] of a mesh, and the normals (N, 3) of their faces."""
    import trimesh

    mesh = trimesh.load_mesh(z1.mesh_dir() / "collision" / f"{name}.STL")
    sampled = trimesh.sample.sample_surface(mesh, _SAMPLES[name], seed=0)
    return np.asarray(sampled[0]), np.asarray(mesh.face_normals)[np.asarray(sampled[1])]
