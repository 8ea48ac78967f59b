"""Possible finger contacts on an object seen from the front: visible surface, and occluded sides behind its outline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from hal.base.errors import InvalidValueError

_NORMAL_NEIGHBORS = 30
_MIN_DEPTH_M = 1e-3  # bearings divide by the depth
_OUTLINE_NEIGHBORS = 12
_OUTLINE_GAP_RAD = np.deg2rad(125.0)  # an inner pixel's neighbours leave no gap above 90°
_EDGE_NEIGHBORS = 40
_CORNER_GAP_RAD = np.deg2rad(228.0)  # a straight edge leaves 180°, a square corner 270°
_SMOOTHING_NEIGHBORS = 24
_SMOOTHING_RADIUS_M = 20e-3
_SMOOTHING_RAD = np.deg2rad(15.0)
_RIM_NEIGHBORS = 9
_RIM_AGREEMENT_RAD = np.deg2rad(30.0)
_INNER_PROBE_M = 10e-3
_FLAT_TURN_RAD = np.deg2rad(10.0)  # below a round body's turn over the probe, above the noise of two normals


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surfels:
    """Possible contact points of a finger, with the outward direction of the surface there."""

    points: np.ndarray
    """(K, 3) [m]."""
    normals: np.ndarray
    """(K, 3) outward unit normals, fitted on the visible side and assumed on the occluded one."""


def estimate_normals(tree: KDTree, at: np.ndarray) -> np.ndarray:
    """Return unit normals (K, 3) of the cloud in `tree` at points `at` (K, 3), towards the camera at the origin."""
    _, neighbors = tree.query(at, k=min(_NORMAL_NEIGHBORS, tree.n))
    patches = tree.data[neighbors]
    centered = patches - patches.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("kni,knj->kij", centered, centered))
    normals = vectors[:, :, 0]
    return np.where(np.sum(normals * at, axis=1, keepdims=True) > 0.0, -normals, normals)


def find_outline(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (K,) of the points on the cloud's outline as the camera sees it, and outward (K, 3).

    A point is on the outline if its neighbours in the image leave a wide empty sector; `outward` is the unit vector
    into that sector, square to the view ray. On a smooth body it is the surface's normal there, for the ray grazes
    the surface. Corners are left out: their outward direction is no surface's normal.

    Raises:
        InvalidValueError: points next to or behind the camera, which is at the origin.
    """
    basis = _view_basis(points)  # (3, 3) rows: right, down, forward
    in_view = points @ basis.T
    if in_view[:, 2].min() < _MIN_DEPTH_M:
        raise InvalidValueError(
            f"The cloud reaches to {in_view[:, 2].min():.3f} m along the view; it must be seen from its origin, "
            "all of it in front. Give it in the camera frame.",
            code="cloud_behind_camera",
        )
    bearings = in_view[:, :2] / in_view[:, 2:]
    tree = KDTree(bearings)
    gaps, _ = _widest_gap(tree, bearings, _OUTLINE_NEIGHBORS)
    rim = np.flatnonzero(gaps > _OUTLINE_GAP_RAD)
    gaps, angles = _widest_gap(tree, bearings[rim], _EDGE_NEIGHBORS)
    straight = (gaps > _OUTLINE_GAP_RAD) & (gaps < _CORNER_GAP_RAD)
    rim, square = rim[straight], _square_to_rim(bearings[rim[straight]], angles[straight])
    agree = np.isfinite(square)
    rim, angles = rim[agree], square[agree]
    outward = np.cos(angles)[:, None] * basis[0] + np.sin(angles)[:, None] * basis[1]
    rays = points[rim] / np.linalg.norm(points[rim], axis=1, keepdims=True)
    return rim, _unit(outward - np.sum(outward * rays, axis=1, keepdims=True) * rays)


def estimate_occluded_sides(
    points: np.ndarray, tree: KDTree, rim: np.ndarray, outward: np.ndarray, setback_m: float
) -> Surfels:
    """Return contacts on the occluded surface just behind the outline.

    Where the visible surface curves towards the outline, the occluded one continues it: the contact is on the
    outline, its normal `outward`. Where it is flat up to the outline, the outline is an edge: the occluded side is
    assumed perpendicular to the visible face, and the contact is `setback_m` behind the edge.

    Args:
        points: (N, 3) the cloud [m].
        tree: of `points`.
        rim: (K,) indices of the outline's points.
        outward: (K, 3) unit vectors out of the outline, square to the view rays.
        setback_m: distance of the contacts behind an edge [m].
    """
    at = points[rim]
    if len(at) == 0:
        return Surfels(points=at, normals=at)
    normals = estimate_normals(tree, at)
    square = _unit(outward - np.sum(outward * normals, axis=1, keepdims=True) * normals)
    # The probe goes inward along the surface: straight across the view it would land inside a round body.
    _, inner = tree.query(at - _INNER_PROBE_M * square)
    inner_normals = estimate_normals(tree, points[inner])
    turn = np.arccos(np.clip(np.sum(normals * inner_normals, axis=1), -1.0, 1.0))
    flat = (turn < _FLAT_TURN_RAD)[:, None]
    half_gap = tree.query(at, k=2)[0][:, 1:].mean() / 2.0  # the last sample is this far inside the true outline
    return Surfels(
        points=at + half_gap * outward - np.where(flat, setback_m * normals, 0.0),
        normals=np.where(flat, square, outward),
    )


def smooth_normals(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return unit normals (K, 3) averaged with those near in place and direction, which keeps edges.

    Fingers are long: 4° off the face moves their roots 3 mm, so the noise of one patch matters.
    """
    if len(points) < 2:
        return normals
    distances, neighbors = KDTree(points).query(points, k=min(_SMOOTHING_NEIGHBORS, len(points)))
    near = normals[neighbors]
    alike = np.einsum("kni,ki->kn", near, normals) > np.cos(_SMOOTHING_RAD)
    weights = alike & (distances < _SMOOTHING_RADIUS_M)
    return _unit(np.einsum("kni,kn->ki", near, weights.astype(float)))


def _view_basis(points: np.ndarray) -> np.ndarray:
    """Return right, down, forward (3, 3) of a view from the origin through the cloud's mean, along its own spread."""
    forward = _unit(points.mean(axis=0)[None])[0]
    centered = points - points.mean(axis=0)
    flat = centered - np.outer(centered @ forward, forward)
    right = np.linalg.eigh(flat.T @ flat)[1][:, 2]
    return np.stack([right, np.cross(forward, right), forward])


def _widest_gap(tree: KDTree, at: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the widest empty sector (K,) [rad] around `at` (K, 2) among its k neighbours, and its middle (K,)."""
    _, neighbors = tree.query(at, k=min(k + 1, tree.n))
    offsets = tree.data[np.asarray(neighbors)[:, 1:]] - at[:, None]
    angles = np.sort(np.arctan2(offsets[..., 1], offsets[..., 0]), axis=1)
    gaps = np.diff(angles, axis=1, append=angles[:, :1] + 2.0 * np.pi)
    widest = np.argmax(gaps, axis=1)
    rows = np.arange(len(at))
    return gaps[rows, widest], angles[rows, widest] + gaps[rows, widest] / 2.0


def _square_to_rim(rim: np.ndarray, outward_rad: np.ndarray) -> np.ndarray:
    """Return the angle (K,) square to the line through each rim point's neighbours on the rim (K, 2) [rad].

    `outward_rad` (K,), the middle of the empty sector, is coarse: it chooses the side, and where the two disagree
    (near a corner) the result is NaN.
    """
    if len(rim) < _RIM_NEIGHBORS:
        return np.full(len(rim), np.nan)
    _, neighbors = KDTree(rim).query(rim, k=_RIM_NEIGHBORS)
    offsets = rim[neighbors] - rim[neighbors].mean(axis=1, keepdims=True)
    across = np.linalg.eigh(np.einsum("kni,knj->kij", offsets, offsets))[1][:, :, 0]
    coarse = np.stack([np.cos(outward_rad), np.sin(outward_rad)], axis=1)
    cosines = np.sum(across * coarse, axis=1)
    across *= np.sign(cosines)[:, None]
    return np.where(np.abs(cosines) > np.cos(_RIM_AGREEMENT_RAD), np.arctan2(across[:, 1], across[:, 0]), np.nan)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
