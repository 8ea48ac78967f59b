"""Input of the networks: a thinned cloud with normals in a frame fixed to the view ray and the object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import KDTree

N_POINTS = 512
"""Points in the networks' input."""
N_TOKENS = 48
"""Points that a grasp attends to; the first of the input."""
_N_FOR_NORMALS = 1024
_NEIGHBOURS = 16


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewCloud:
    """Visible points of one object in the networks' input format."""

    points: np.ndarray
    """(512, 3) in the view frame [m]; the first 48 by farthest point sampling."""
    normals: np.ndarray
    """(512, 3) unit, towards the camera, in the view frame."""
    T_camera_view: np.ndarray
    """(4, 4) pose of the view frame: origin at the centroid, z along the view ray, x along the longest extent."""


def prepare_cloud(points: np.ndarray, rng: np.random.Generator) -> ViewCloud:
    """Return `points` (M, 3), seen from their origin, as input of the networks.

    The view frame is fixed to the view ray and to the cloud's own longest extent across it, so that turning the camera
    about any axis turns the grasps and changes nothing else. Gravity, table and image axes are not used.
    """
    T_camera_view = find_view_frame(points)
    kept = points[rng.permutation(len(points))[:_N_FOR_NORMALS]]
    local = (kept - T_camera_view[:3, 3]) @ T_camera_view[:3, :3]
    normals = _estimate_normals(local, float(np.linalg.norm(T_camera_view[:3, 3])))
    drawn = np.resize(rng.permutation(len(local)), N_POINTS)  # a smaller cloud repeats its points
    first = _sample_farthest(local[drawn])
    index = np.concatenate([drawn[first], np.delete(drawn, np.unique(first))])[:N_POINTS]
    index = np.resize(index, N_POINTS)
    return ViewCloud(points=local[index], normals=normals[index], T_camera_view=T_camera_view)


def find_view_frame(points: np.ndarray) -> np.ndarray:
    """Return T_camera_view (4, 4) of `points` (M, 3) seen from their origin."""
    center = points.mean(axis=0)
    z = center / np.linalg.norm(center)
    across = points - center
    across = across - (across @ z)[:, None] * z
    _, axes = np.linalg.eigh(across.T @ across)
    # Removes what rounding leaves along the view ray
    x = axes[:, 2] - (axes[:, 2] @ z) * z
    x /= np.linalg.norm(x)
    if np.sum((across @ x) ** 3) < 0.0:  # the longer tail shows along +x
        x = -x
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = center
    return T


def _estimate_normals(local: np.ndarray, distance_m: float) -> np.ndarray:
    """Return unit normals (N, 3) towards the camera at (0, 0, −distance)."""
    _, near = KDTree(local).query(local, k=min(_NEIGHBOURS, len(local)))
    patches = local[near]
    patches = patches - patches.mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", patches, patches))
    normals = axes[:, :, 0]
    towards = np.array([0.0, 0.0, -distance_m]) - local
    return normals * np.where(np.sum(normals * towards, axis=1) < 0.0, -1.0, 1.0)[:, None]


@njit(cache=True)
def _sample_farthest(points):
    """Return indices (48,) of points by farthest point sampling."""
    chosen = np.zeros(N_TOKENS, dtype=np.int64)
    gap = np.full(len(points), 1e9)
    for k in range(1, N_TOKENS):
        last = points[chosen[k - 1]]
        for i in range(len(points)):
            d = (points[i, 0] - last[0]) ** 2 + (points[i, 1] - last[1]) ** 2 + (points[i, 2] - last[2]) ** 2
            gap[i] = min(gap[i], d)
        chosen[k] = np.argmax(gap)
    return chosen
