"""How the camera sits on the hand, seen by itself: the jaws are always in its picture, and their shape is known.

A mount that is off by 3 mm and 1° shows an object 0.4 m away up to 10 mm beside its place: too far for a grasp. The
depth of the jaws, laid onto their meshes by iterative closest points (point to plane), tells that place to 0.8 mm in
the mean, 2.2 mm at worst (scripts/measure/measure_extrinsics_check.py: 21 looks in the twin); so a camera that was
knocked is made up for.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.messages import RgbdFrame
from hal.base.transforms import inverse, transform_points
from hal.base.z1_gripper import T_FLANGE_STATIONARY_JAW, moving_jaw_pose
from z1_runtime.perception.self_filter import SelfFilter

_SAMPLES = {"z1_GripperStator": 50_000, "z1_GripperMover": 30_000}
_ROUNDS, _FIRST_M, _LAST_M, _NARROWING = 20, 0.012, 0.002, 0.75
_STILL = 1e-4  # of a step: rad, and metres
_SPARSE = 4  # on the way there, one in so many points will do
_SOFT_M = 0.001  # residuals beyond count ever less
_FEWEST_PX = 300
_AHEAD_M = 0.4  # where objects are when they are looked at: there a mount's error is judged


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtrinsicsCheck:
    """When the mount that the jaws show is believed."""

    enabled: bool = True
    """Whether it is looked for at all."""
    least_m: float = 0.002
    """Unless it moves what is 0.4 m ahead by more than this, the given mount stays as it is [m]."""
    most_m: float = 0.020
    """If it moves that by more than this, something else is in view, and the given mount stays [m]."""
    least_share: float = 0.8
    """Share of the jaws' pixels that must lie on their meshes within 2 mm."""
    most_rms_m: float = 0.0006
    """Root mean square distance of those from the meshes [m]; jaws of another make do not fit as closely."""
    points: int = 4000
    """Pixels that are laid onto the meshes."""
    own: SelfFilter = field(default_factory=lambda: SelfFilter(margin_m=0.012))
    """Which pixels may show the jaws."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.least_m < self.most_m < 0.1:
            raise InvalidValueError(
                f"least_m and most_m are {self.least_m} and {self.most_m}; 0 <= least < most < 0.1 m."
            )
        if not 0.0 < self.least_share <= 1.0 or not 0.0 < self.most_rms_m < 0.01:
            raise InvalidValueError(
                f"least_share is {self.least_share}, allowed is above 0 up to 1; "
                f"most_rms_m is {self.most_rms_m}, allowed is above 0, below 0.01 m."
            )
        if self.points < _FEWEST_PX:
            raise InvalidValueError(f"points is {self.points}; allowed is {_FEWEST_PX} or more.")

    def correct(self, frame: RgbdFrame, jaw: float, T_flange_camera: np.ndarray) -> ExtrinsicsEstimate | None:
        """Return the mount that the jaws show, where it is to be believed and another than the given one; else None.

        Args:
            frame: depth with the jaws in view.
            jaw: mover angle when it was taken [rad].
            T_flange_camera: (4, 4) the mount as far as it is known.
        """
        seen = self.see(frame, jaw, T_flange_camera) if self.enabled else None
        if seen is None or seen.share < self.least_share or seen.rms_m > self.most_rms_m:
            return None
        return seen if self.least_m < seen.moved_m < self.most_m else None

    def see(self, frame: RgbdFrame, jaw: float, T_flange_camera: np.ndarray) -> ExtrinsicsEstimate | None:
        """Return the mount that lays the jaws' depth onto their meshes; None where too little of them is seen."""
        points = self._jaw_points(frame, jaw, T_flange_camera)
        if len(points) < _FEWEST_PX:
            return None
        surface, normals = _jaws(jaw)
        lens = T_flange_camera[:3, 3]
        facing = np.einsum("ij,ij->i", surface - lens, normals) < 0.0
        surface, normals = surface[facing], normals[facing]
        tree, T = cKDTree(surface), T_flange_camera.copy()
        near, offsets = np.zeros(0, dtype=bool), np.zeros(0)
        for number in range(_ROUNDS):
            within = max(_FIRST_M * _NARROWING**number, _LAST_M)
            at = transform_points(T, points if within == _LAST_M else points[::_SPARSE])
            distances, nearest = tree.query(at, distance_upper_bound=within)
            near = np.isfinite(distances)
            n, at = normals[nearest[near]], at[near]
            offsets = np.einsum("ij,ij->i", at - surface[nearest[near]], n)
            step = _step(at, n, offsets)
            T = step @ T
            if within == _LAST_M and np.abs(step - np.eye(4)).max() < _STILL:
                break
        moved = np.array([0.0, 0.0, _AHEAD_M])
        return ExtrinsicsEstimate(
            T_flange_camera=T,
            moved_m=float(np.linalg.norm(transform_points(inverse(T_flange_camera) @ T, moved[None])[0] - moved)),
            share=float(near.mean()),
            rms_m=float(np.sqrt(np.mean(offsets**2))) if len(offsets) else np.inf,
        )

    def _jaw_points(self, frame: RgbdFrame, jaw: float, T_flange_camera: np.ndarray) -> np.ndarray:
        """Return points (N, 3) in the camera's frame that may show the jaws."""
        reach = self.own.reach_m(frame.intrinsics, jaw, T_flange_camera)
        v, u = np.nonzero((frame.depth_m > 0.0) & (frame.depth_m <= reach))
        chosen = np.random.default_rng(0).permutation(len(u))[: self.points]
        u, v, i = u[chosen], v[chosen], frame.intrinsics
        return i.deproject(u, v, frame.depth_m[v, u])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExtrinsicsEstimate:
    """What the jaws say of the mount."""

    T_flange_camera: np.ndarray
    """(4, 4)."""
    moved_m: float
    """How far what lies 0.4 m ahead of the lens moves by it [m]."""
    share: float
    """Of the pixels, those that lie on the meshes within 2 mm."""
    rms_m: float
    """Root mean square distance of those from the meshes [m]."""


def warm_up() -> None:
    """Read and sample the meshes, so that the first look is as fast as the next."""
    _jaws(z1.GRIPPER_CLOSED)


def _step(at: np.ndarray, normals: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return the small motion (4, 4) of points (N, 3) that brings them closest to planes `offsets` (N,) below them."""
    weights = 1.0 / (1.0 + (offsets / _SOFT_M) ** 2)
    jacobian = np.column_stack([normals, np.cross(at, normals)])
    weighted = jacobian * weights[:, None]
    x = np.linalg.solve(weighted.T @ jacobian + 1e-6 * np.eye(6), -weighted.T @ offsets)
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = Rotation.from_rotvec(x[3:]).as_matrix(), x[:3]
    return step


def _jaws(jaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Return surface points (N, 3) [m] and outward normals (N, 3) of both jaws in the flange frame."""
    (fixed, fixed_normals), (mover, mover_normals) = (_sampled(name) for name in _SAMPLES)
    T_stator, T_mover = T_FLANGE_STATIONARY_JAW, z1.T_FLANGE_PIVOT @ moving_jaw_pose(jaw)
    points = [transform_points(T_stator, fixed), transform_points(T_mover, mover)]
    return np.concatenate(points), np.concatenate(
        [fixed_normals @ T_stator[:3, :3].T, mover_normals @ T_mover[:3, :3].T]
    )


@cache
def _sampled(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return random surface points (N, 3) [m] of a mesh, and the normals (N, 3) of the faces that they lie on."""
    import trimesh

    mesh = trimesh.load_mesh(z1.mesh_dir() / "collision" / f"{name}.STL")
    sampled = trimesh.sample.sample_surface(mesh, _SAMPLES[name], seed=0)
    return np.asarray(sampled[0]), np.asarray(mesh.face_normals)[np.asarray(sampled[1])]
