"""Rigid motions as (..., 4, 4) matrices, and their small changes ξ = (ρ [m], ω [rad])."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.errors import CalibrationError


def inverse(T_a_b: np.ndarray) -> np.ndarray:
    """Return T_b_a of T_a_b, both (..., 4, 4)."""
    T_b_a = np.zeros_like(T_a_b)
    T_b_a[..., :3, :3] = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a[..., :3, 3] = -np.einsum("...ij,...j->...i", T_b_a[..., :3, :3], T_a_b[..., :3, 3])
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def moved(T_a_b: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return the (4, 4) pose changed by `step` (6,) in b's axes: position p + R ρ, rotation R Exp(ω)."""
    T = T_a_b.copy()
    T[:3, 3] += T_a_b[:3, :3] @ step[:3]
    T[:3, :3] = T_a_b[:3, :3] @ Rotation.from_rotvec(step[3:]).as_matrix()
    return T


def rotation_vectors(R: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (..., 3) [rad] of matrices (..., 3, 3)."""
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(*R.shape[:-2], 3)


def skew(v: np.ndarray) -> np.ndarray:
    """Return K (..., 3, 3) with K @ x = v × x."""
    K = np.zeros((*v.shape, 3))
    K[..., 2, 1], K[..., 0, 2], K[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return K - np.swapaxes(K, -1, -2)


def distance(T_a_b: np.ndarray, T_a_c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far apart poses (..., 4, 4) are: distances [mm] and angles [°]."""
    R = np.swapaxes(T_a_b[..., :3, :3], -1, -2) @ T_a_c[..., :3, :3]
    mm = 1e3 * np.linalg.norm(T_a_b[..., :3, 3] - T_a_c[..., :3, 3], axis=-1)
    return mm, np.degrees(np.linalg.norm(rotation_vectors(R), axis=-1))


def check_poses(Ts: np.ndarray, name: str) -> np.ndarray:
    """Return `Ts` as float64 (N, 4, 4) with exact rotations.

    Raises:
        CalibrationError: `bad_poses`: wrong shape, values that are not finite, or rotations that are not.
    """
    Ts = np.array(Ts, dtype=np.float64)
    if Ts.ndim != 3 or Ts.shape[1:] != (4, 4):
        raise CalibrationError("bad_poses", f"{name} has the shape {Ts.shape}; it must be (N, 4, 4).")
    R = Ts[:, :3, :3]
    with np.errstate(invalid="ignore"):
        skewed = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        good = np.isfinite(Ts).all(axis=(1, 2)) & (skewed < 1e-4) & (np.linalg.det(R) > 0.0)
        good &= np.abs(Ts[:, 3] - (0.0, 0.0, 0.0, 1.0)).max(axis=1, initial=0.0) < 1e-6
    if not good.all():
        bad = int(np.flatnonzero(~good)[0])
        raise CalibrationError("bad_poses", f"{name}[{bad}] is no rigid motion:\n{Ts[bad]}")
    if len(Ts):
        Ts[:, :3, :3] = Rotation.from_matrix(R).as_matrix()
    return Ts
