"""Rigid transforms as (4, 4) matrices: inverse, distance between two poses, straight interpolation."""

from __future__ import annotations

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports] - a .pth file leads to it
from scipy.spatial.transform import Rotation

from hal.base.errors import InvalidValueError

_ORTHONORMAL_ATOL = 1e-6
"""Rotation matrices that went through float32 pass, anything worse is a mistake."""


def make_pose(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the (4, 4) pose of rotation `R` (3, 3) and position `p` (3,) [m]."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = p
    return T


def check_pose(T: np.ndarray, name: str) -> np.ndarray:
    """Return `T` as a float64 (4, 4) pose.

    Raises:
        ValueError: wrong shape, values that are not finite, or a rotation that is not one.
    """
    T = np.asarray(T, dtype=np.float64)
    if T.shape != (4, 4):
        raise InvalidValueError(f"{name} has shape {T.shape}; a pose is (4, 4).", code="pose")
    if not np.isfinite(T).all():
        raise InvalidValueError(f"{name} holds values that are not finite:\n{T}", code="pose")
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _ORTHONORMAL_ATOL or np.linalg.det(R) < 0.0:
        raise InvalidValueError(f"{name} has no right-handed orthonormal rotation:\n{R}", code="pose")
    if np.abs(T[3] - (0.0, 0.0, 0.0, 1.0)).max() > _ORTHONORMAL_ATOL:
        raise InvalidValueError(f"{name} has the last row {T[3]}; it must be (0, 0, 0, 1).", code="pose")
    return T


def inverse(T_a_b: np.ndarray) -> np.ndarray:
    """Return T_b_a of T_a_b, both (..., 4, 4)."""
    T_b_a = np.zeros_like(T_a_b)
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a[..., :3, :3] = R_b_a
    T_b_a[..., :3, 3] = -np.einsum("...ij,...j->...i", R_b_a, T_a_b[..., :3, 3])
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def transform_points(T_parent_child: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return `points` (N, 3), given in the child frame, in the parent frame."""
    return points @ T_parent_child[:3, :3].T + T_parent_child[:3, 3]


def error_twist(T_base_a: np.ndarray, T_base_b: np.ndarray) -> np.ndarray:
    """Return the (6,) step from a to b in base axes: translation [m], then rotation vector [rad]."""
    step = np.empty(6)
    step[:3] = T_base_b[:3, 3] - T_base_a[:3, 3]
    step[3:] = pin.log3(T_base_b[:3, :3] @ T_base_a[:3, :3].T)
    return step


def pose_error(T_base_a: np.ndarray, T_base_b: np.ndarray) -> tuple[float, float]:
    """Return the distance [m] and the angle [rad] between two poses."""
    step = error_twist(T_base_a, T_base_b)
    return float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:]))


def interpolate(T_base_a: np.ndarray, T_base_b: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return the (N, 4, 4) poses at fractions `s` (N,) of the way: LERP of position, SLERP of orientation.

    At 180° between the two the axis of the turn is ambiguous; one is taken, always the same.
    """
    s = np.asarray(s, dtype=np.float64)
    step = error_twist(T_base_a, T_base_b)
    angle = float(np.linalg.norm(step[3:]))
    K = pin.skew(step[3:] / angle) if angle > 0.0 else np.zeros((3, 3))
    sin, one_minus_cos = np.sin(s * angle), 1.0 - np.cos(s * angle)
    # Rodrigues' formula for all fractions at once
    R_steps = np.eye(3) + sin[:, None, None] * K + one_minus_cos[:, None, None] * (K @ K)
    Ts = np.zeros((len(s), 4, 4))
    Ts[:, :3, :3] = R_steps @ T_base_a[:3, :3]
    Ts[:, :3, 3] = T_base_a[:3, 3] + s[:, None] * step[:3]
    Ts[:, 3, 3] = 1.0
    return Ts


def skew(v: np.ndarray) -> np.ndarray:
    """Return K (..., 3, 3) of vectors (..., 3), with K @ x = v × x."""
    K = np.zeros((*v.shape, 3))
    K[..., 2, 1], K[..., 0, 2], K[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return K - np.swapaxes(K, -1, -2)


def rotation_vectors(R: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (..., 3) [rad] of matrices (..., 3, 3)."""
    return Rotation.from_matrix(R).as_rotvec()


def apply_increment(T_parent_child: np.ndarray, increment: np.ndarray) -> np.ndarray:
    """Return poses (..., 4, 4) changed by increments ξ = (ρ [m], ω [rad]) (..., 6) in the child's axes.

    The position becomes p + R ρ and the rotation R Exp(ω): translation and rotation stay decoupled, unlike in the
    exponential map of SE(3).
    """
    R = T_parent_child[..., :3, :3]
    T = T_parent_child.copy()
    T[..., :3, 3] += (R @ increment[..., :3, None])[..., 0]
    # Rotation and not RigidTransform, which takes ten times as long for one pose and is called in inner loops
    T[..., :3, :3] = R @ Rotation.from_rotvec(increment[..., 3:]).as_matrix()
    return T


def pose_distances(Ts_parent_a: np.ndarray, Ts_parent_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances (...) [m] and the angles (...) [rad] between poses (..., 4, 4), which may broadcast."""
    R_a_b = np.swapaxes(Ts_parent_a[..., :3, :3], -1, -2) @ Ts_parent_b[..., :3, :3]
    distances_m = np.linalg.norm(Ts_parent_a[..., :3, 3] - Ts_parent_b[..., :3, 3], axis=-1)
    return distances_m, np.linalg.norm(rotation_vectors(R_a_b), axis=-1)
