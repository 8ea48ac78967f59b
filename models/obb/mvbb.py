"""Core of MVB-Grasp: selection, among many grasps, of those that approach a visible face of the object's box."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hal.base.errors import InvalidValueError
from models.obb.obb import FACE_AXES, DegenerateCloudError, OrientedBox, min_volume_axes, principal_axes, upright_axes
from models.types import GraspSet

FitMethod = Literal["pca", "min_volume", "upright"]
SCORE_EPSILON = 1e-6
"""Keeps the score normalisation finite when all scores are equal (the paper's ε)."""

# Fewer points than those of a tetrahedron enclose no volume
_MIN_POINTS = 4
_THICKNESS_FLOOR_M = 1e-3
_COLLINEAR_STD_M = 1e-5
_FRONT_SLAB_M = 4e-3  # points less far behind the front face than this are noise of that face
_VISIBLE_FACE_RATIO = 0.02  # a side face counts as visible when it holds at least this ratio of the points


def fit_obb(
    points: np.ndarray,
    method: FitMethod | None = None,
    *,
    up: np.ndarray | None = None,
    percentile: tuple[float, float] = (1.0, 99.0),
) -> OrientedBox:
    """Fit a box to `points` (N, 3) [m], seen by a camera at the origin of their frame.

    `pca` is the paper's: principal axes. `min_volume` is the minimum-volume box. `upright` has its z along `up` and
    follows the visible side faces; it is the default where `up` is known, since on partial views the paper's box has
    twice the minimum volume and is 20° off.

    Signs: `upright` has z = up and x the horizontal axis closest to the camera's direction; the others have x along
    the longest and z along the shortest edge, with x and y towards the camera. All are right-handed. No edge is
    shorter than 1 mm, so a planar cloud has a defined box.

    Args:
        points: (N, 3) [m].
        method: choice of the axes; None takes `upright` if `up` is given, else `pca`.
        up: (3,) direction against gravity, of any length.
        percentile: the box reaches between these percentiles of the points along each axis [%].

    Raises:
        DegenerateCloudError: fewer than 4 points, points not finite, or all on one line or in one place.
        InvalidValueError: unknown method, `upright` without a direction, or percentiles out of order.
    """
    if not 0.0 <= percentile[0] < percentile[1] <= 100.0:
        raise InvalidValueError(
            f"percentile is {percentile}; give (low, high) with 0 ≤ low < high ≤ 100.", code="percentile"
        )
    points, axes = _check_points(points)
    method = method or ("pca" if up is None else "upright")
    if method == "upright":
        axes = upright_axes(points, _unit_up(up))
    elif method == "min_volume":
        axes = min_volume_axes(points, axes)
    elif method != "pca":
        raise InvalidValueError(f"Unknown box method {method!r}; choose pca, min_volume or upright.", code="box_method")
    along = axes.T @ points.T  # (3, N), a contiguous row for each axis
    # Not extremes: one flying pixel 30 cm off stretched a box of 6 × 10 × 18 cm to 11 × 19 × 58 cm (measured)
    low, high = np.array([_ends(row, percentile) for row in along]).T
    middle, half = (low + high) / 2, np.maximum(high - low, _THICKNESS_FLOOR_M) / 2
    unobserved = _unobserved_axes(along, middle, half)
    center = axes @ middle
    order, R_camera_box = _canonical(axes, center, half, upright=method == "upright")
    T_camera_box = np.eye(4)
    T_camera_box[:3, :3], T_camera_box[:3, 3] = R_camera_box, center
    return OrientedBox(T_camera_box=T_camera_box, half_extents_m=half[order], unobserved=unobserved[order])


def nearest_faces(box: OrientedBox, k: int, origin: np.ndarray | None = None) -> np.ndarray:
    """Return the indices (k,) of the faces whose centres are nearest to `origin` (3,), the camera, nearest first.

    The far face of an unobserved axis comes last: its position was never observed. In the thin box of a one-face
    view it would be the second nearest, and admit grasps from behind the object.
    """
    if not 1 <= k <= len(FACE_AXES):
        raise InvalidValueError(f"k is {k}; a box has 1 to 6 faces to choose from.", code="face_count")
    offsets = box.face_centers_m - (np.zeros(3) if origin is None else origin)
    distances = np.linalg.norm(offsets, axis=1)
    turned_away = np.sum(box.face_normals * offsets, axis=1) > 0.0
    distances[box.unobserved[FACE_AXES] & turned_away] = np.inf
    return np.argsort(distances, kind="stable")[:k]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RankedGrasps:
    """Grasp candidates in the order in which they are tried."""

    grasps: GraspSet
    """The M grasps kept, best first."""
    indices: np.ndarray
    """(M,) index of each in the set that was ranked."""
    scores: np.ndarray
    """(M,) ranking scores, in descending order."""
    alignments: np.ndarray
    """(M,) the paper's a_j, in (0, 1] unless the hard filter was off; NaN when no box was used."""
    box: OrientedBox | None
    """The object's box; None for the baseline by score alone."""
    faces: np.ndarray
    """(k,) the faces whose approach was accepted, nearest first."""

    def __len__(self) -> int:
        return len(self.indices)

    def reordered(self, scores: np.ndarray) -> RankedGrasps:
        """Return the same grasps ranked by other `scores` (M,), the greatest first; equal ones keep their order."""
        order = np.argsort(-scores, kind="stable")
        return replace(
            self,
            grasps=self.grasps[order],
            indices=self.indices[order],
            scores=scores[order],
            alignments=self.alignments[order],
        )


def rank_grasps(
    grasps: GraspSet, box: OrientedBox, *, k: int = 2, alpha: float = 0.85, hard_filter: bool = True
) -> RankedGrasps:
    """Keep the grasps that approach one of the `k` nearest faces, and rank them by alignment and score.

    The paper's a_j = max over those faces of −z_jᵀn, the hard filter a_j > 0, and α·a_j + (1 − α)·s̄_j, where
    s̄ = (s − min) / (max − min + ε) spans the scores of the grasps that passed the filter: a rejected grasp does not
    influence the order of the others. Equal grasps keep their order. An empty result is valid.

    Args:
        grasps: N candidates in the camera frame of `box`.
        box: the object's box.
        k: number of faces that may be approached, 1 to 6.
        alpha: weight of the alignment against the generator's score, in [0, 1].
        hard_filter: False keeps the rejected ones too, for ablations; they rank low by their alignment.
    """
    if not 0.0 <= alpha <= 1.0:
        raise InvalidValueError(
            f"alpha is {alpha}; allowed is 0 to 1, the weight of alignment against score.", code="alpha"
        )
    faces = nearest_faces(box, k)
    approaches = grasps.T_camera_grasps[:, :3, 2]
    alignments = np.max(-approaches @ box.face_normals[faces].T, axis=1)
    # The paper's hard filter, a_j > 0
    kept = np.flatnonzero(alignments > 0.0) if hard_filter else np.arange(len(grasps))
    # The paper's 0.85 · alignment + 0.15 · score
    combined = alpha * alignments[kept] + (1.0 - alpha) * _normalised(grasps.scores[kept])
    order = np.argsort(-combined, kind="stable")
    indices = kept[order]
    return RankedGrasps(
        grasps=grasps[indices],
        indices=indices,
        scores=combined[order],
        alignments=alignments[indices],
        box=box,
        faces=faces,
    )


def rank_by_score(grasps: GraspSet) -> RankedGrasps:
    """Rank all grasps by the generator's score alone: the paper's vanilla baseline, without box or filter."""
    indices = np.argsort(-grasps.scores, kind="stable")
    return RankedGrasps(
        grasps=grasps[indices],
        indices=indices,
        scores=grasps.scores[indices],
        alignments=np.full(len(indices), np.nan),
        box=None,
        faces=np.zeros(0, dtype=np.intp),
    )


def _normalised(scores: np.ndarray) -> np.ndarray:
    if len(scores) == 0:
        return scores
    return (scores - scores.min()) / (scores.max() - scores.min() + SCORE_EPSILON)


def _check_points(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `points` as float64 (N, 3) and their principal axes (3, 3).

    Raises:
        DegenerateCloudError: the points span no box.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise DegenerateCloudError(f"A cloud is an (N, 3) array; got {points.shape}.")
    if len(points) < _MIN_POINTS:
        raise DegenerateCloudError(f"The cloud has {len(points)} points; a box needs {_MIN_POINTS} or more.")
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points).all(axis=1)).sum())
        raise DegenerateCloudError(f"{bad} of {len(points)} points are NaN or infinite; drop invalid depth first.")
    std_m, axes = principal_axes(points)
    if std_m[1] < _COLLINEAR_STD_M:
        raise DegenerateCloudError(f"All {len(points)} points are in one place or on one line; no box has that axis.")
    return points, axes


def _unit_up(up: np.ndarray | None) -> np.ndarray:
    if up is None:
        raise InvalidValueError(
            "An upright box needs `up`, the direction against gravity in the camera frame; or use pca.", code="up"
        )
    up = np.asarray(up, dtype=np.float64)
    if up.shape != (3,) or not np.isfinite(up).all() or not np.linalg.norm(up) > 0.0:
        raise InvalidValueError(f"`up` is {up}; it must be a finite (3,) vector that is not zero.", code="up")
    return up / np.linalg.norm(up)


def _ends(values: np.ndarray, percentile: tuple[float, float]) -> tuple[float, float]:
    """Return the nearest-rank percentiles of `values` (N,), at a tenth of the cost of `np.percentile`."""
    ranks = [round((len(values) - 1) * p / 100.0) for p in percentile]
    low, high = np.partition(values, ranks)[ranks]
    return float(low), float(high)


def _canonical(
    axes: np.ndarray, center: np.ndarray, half: np.ndarray, *, upright: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the order (3,) and the right-handed rotation (3, 3) of the axes, by the convention of `fit_obb`."""
    toward_camera = -center @ axes
    turned = axes * np.where(toward_camera < 0.0, -1.0, 1.0)
    if upright:
        front = int(np.argmax(np.abs(toward_camera[:2])))
        x_axis, z_axis = turned[:, front], axes[:, 2]
        return np.array([front, 1 - front, 2]), np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], axis=1)
    order = np.argsort(-half, kind="stable")
    x_axis, y_axis = turned[:, order[0]], turned[:, order[1]]
    return order, np.stack([x_axis, y_axis, np.cross(x_axis, y_axis)], axis=1)


def _unobserved_axes(along: np.ndarray, middle: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return (3,) bool: the axis along the view, if only the front face is visible.

    A side face is visible when it is turned to the camera and holds points behind the slab of the front face.

    Args:
        along: (3, N) coordinates of the points along the box's axes, the camera at their origin [m].
        middle: (3,) centre of the box along those axes [m].
        half: (3,) half extents [m].
    """
    view = int(np.argmax(np.abs(middle)))
    visible_sides = [axis for axis in range(3) if axis != view and abs(middle[axis]) > half[axis]]
    unobserved = np.zeros(3, dtype=bool)
    unobserved[view] = True
    if visible_sides:
        behind_front = _depth_below_near_face(along, middle, half, view) > _FRONT_SLAB_M
        for side in visible_sides:
            on_side = behind_front & (_depth_below_near_face(along, middle, half, side) < _FRONT_SLAB_M)
            if np.count_nonzero(on_side) >= _VISIBLE_FACE_RATIO * along.shape[1]:
                unobserved[view] = False
    return unobserved


def _depth_below_near_face(along: np.ndarray, middle: np.ndarray, half: np.ndarray, axis: int) -> np.ndarray:
    """Return the depths (N,) of the points below the face of `axis` that is nearer to the camera [m]."""
    return half[axis] + np.sign(middle[axis]) * (along[axis] - middle[axis])
