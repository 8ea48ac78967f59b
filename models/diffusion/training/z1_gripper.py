"""The Z1's gripper as a target of the training: one stationary jaw, and one that turns, fitted around a width.

`pivot` is the frame of the moving jaw's axis (`hal.base.z1`): x towards the tips, y along the axis, the
stationary jaw at −z. In the grasp frame y runs from the stationary jaw to the moving one, so this gripper is not its
own mirror image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numba import njit

from hal.base.z1 import (
    HALF_WIDTH,
    MOVING_BACK,
    MOVING_FACE,
    PALM_HALF_WIDTH_M,
    ROOT_RADIUS_M,
    STATIONARY_BACK,
    STATIONARY_FACE,
    WRIST_HALF_M,
    WRIST_X_M,
)
from models.diffusion.network import MAX_WIDTHS_M
from models.diffusion.training.solids import distance_at, normal_at, trace

GRIPPER_FIT = (
    (0.004, 0.3007, 0.0763, 0.0025, 0.0517),
    (0.012, 0.4080, 0.0753, 0.0065, 0.1052),
    (0.020, 0.5186, 0.0738, 0.0105, 0.1883),
    (0.028, 0.6320, 0.0719, 0.0143, 0.2856),
    (0.036, 0.7471, 0.0696, 0.0179, 0.3233),
    (0.044, 0.8639, 0.0671, 0.0215, 0.3688),
    (0.052, 0.9836, 0.0645, 0.0249, 0.4319),
    (0.060, 1.1071, 0.0619, 0.0282, 0.5093),
    (0.068, 1.1992, 0.0640, 0.0331, 0.5149),
    (0.076, 1.2787, 0.0660, 0.0376, 0.5511),
    (0.084, 1.3469, 0.0681, 0.0420, 0.5827),
)
"""Pose of the opened gripper around a width: width [m], opening [rad], object's middle x, z in the pivot frame [m],
tilt of the approach from x [rad]. Output of the runtime's gripper fit at the time of the training, which fixes the
labels; a test compares the two."""
CONTACT_DEPTH_M = 0.012
"""Distance from the middle of the contacts to the grasp's origin along the approach [m]; same source."""

_SAME_CONTACT_M = 0.0015
_HIT_M = 2e-4  # as in `solids.trace`
_MAX_GAP_M = 0.025  # maximum distance that an object is pushed to the stationary jaw


@dataclass(frozen=True, kw_only=True)
class Z1GripperSpec:
    """Gripper with one moving jaw, in the grasp frame: z approach, y from the stationary jaw to the moving one."""

    name: str
    max_width_m: float = MAX_WIDTHS_M["z1"]
    """Widest object that ground truth closes on [m]."""
    min_width_m: float = 0.004
    """Narrowest [m]."""
    min_depth_m: float = 0.007
    """Minimum distance from the contacts' middle to the grasp's origin in ground truth [m]."""
    max_depth_m: float = 0.017
    """Maximum [m]."""
    friction: float = 0.5
    """Coulomb coefficient that a valid grasp may count on."""
    symmetric: ClassVar[bool] = False
    """Whether the gripper is the same turned over."""

    @cached_property
    def stationary_points(self) -> np.ndarray:
        """(K, 3) points on stationary jaw, palm and wrist in the pivot frame, for the collision check [m]."""
        angle = np.arctan2(-0.0185, 0.0281) - np.linspace(0.0, 1.5 * np.pi, 9)  # from the stationary jaw's root on
        circle = ROOT_RADIUS_M * np.column_stack([np.cos(angle), np.sin(angle)])
        palm = [np.column_stack([circle[:, 0], np.full(9, y), circle[:, 1]]) for y in PALM_HALF_WIDTH_M * _ACROSS]
        half = WRIST_HALF_M
        wrist = np.array([(x, y, z) for x in WRIST_X_M for y in (-half, half) for z in (-half, 0.0, half)])
        return np.concatenate([_across(np.concatenate([_LABEL_FACE, STATIONARY_BACK])), *palm, wrist])

    @cached_property
    def moving_points(self) -> np.ndarray:
        """(K, 3) points on the moving jaw when closed, in the pivot frame [m]."""
        return _across(np.concatenate([MOVING_FACE, MOVING_BACK]))

    @cached_property
    def stationary_face_points(self) -> np.ndarray:
        """(P, 3) points of the stationary jaw that objects lean on [m]."""
        return _across(_resample(_LABEL_FACE))

    @cached_property
    def moving_face_points(self) -> np.ndarray:
        """(P, 3) points of the moving jaw that push, when closed [m]."""
        return _across(_resample(MOVING_FACE))


_ACROSS = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
_LABEL_FACE = STATIONARY_FACE[:5]  # the labels were made without the face's last point, which the root covers


def _across(outline: np.ndarray) -> np.ndarray:
    """Return points (5 K, 3) of an outline (K, 2), five over the jaw's width."""
    x, z = outline.T
    half = np.interp(x, *HALF_WIDTH.T)
    return np.concatenate([np.column_stack([x, fraction * half, z]) for fraction in _ACROSS])


def _resample(points: np.ndarray, spacing_m: float = 0.006) -> np.ndarray:
    """Return `points` (K, 2) of a polyline at about `spacing_m` along it, (L, 2)."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], round(along[-1] / spacing_m) + 1)
    return np.column_stack([np.interp(at, along, points[:, 0]), np.interp(at, along, points[:, 1])])


@njit(cache=True)
def _place(T, fit, width):
    """Return T_object_pivot (4, 4) and the opening [rad] of the gripper fitted around `width` for the grasp `T`."""
    opening = np.interp(width, fit[:, 0], fit[:, 1])
    x, z = np.interp(width, fit[:, 0], fit[:, 2]), np.interp(width, fit[:, 0], fit[:, 3])
    tilt = np.interp(width, fit[:, 0], fit[:, 4])
    c, s = np.cos(tilt), np.sin(tilt)
    T_grasp_pivot = np.zeros((4, 4))
    T_grasp_pivot[0, 1] = T_grasp_pivot[3, 3] = 1.0
    T_grasp_pivot[1, 0], T_grasp_pivot[1, 2] = -s, c
    T_grasp_pivot[2, 0], T_grasp_pivot[2, 2] = c, s
    T_grasp_pivot[1, 3], T_grasp_pivot[2, 3] = s * x - c * z, -(c * x + s * z) - CONTACT_DEPTH_M
    return T @ T_grasp_pivot, opening


@njit(cache=True)
def _at(T, x, y, z):
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@njit(cache=True)
def _turn(p, opening):
    """Return a point of the closed moving jaw when it is opened."""
    c, s = np.cos(opening), np.sin(opening)
    return c * p[0] - s * p[2], p[1], s * p[0] + c * p[2]


@njit(cache=True)
def _clear(parts, profiles, T, points, opening, clearance):  # noqa: PLR0917 (compiled functions take no keywords)
    for k in range(len(points)):
        x, y, z = _turn(points[k], opening)
        px, py, pz = _at(T, x, y, z)
        if distance_at(parts, profiles, px, py, pz) <= clearance:
            return False
    return True


@njit(cache=True)
def _close(parts, profiles, T, face, opening):
    """Close the jaw until it touches; return the contact's middle (3,), its normal (3,), and whether there is one."""
    reach = np.empty(len(face))
    for k in range(len(face)):
        p = face[k]
        radius = np.sqrt(p[0] ** 2 + p[2] ** 2)
        angle = opening
        for _ in range(80):
            x, y, z = _turn(p, angle)
            px, py, pz = _at(T, x, y, z)
            d = distance_at(parts, profiles, px, py, pz)
            if d < _HIT_M or angle <= 0.0:
                break
            angle -= d / radius  # the arc is longer than the gap, so this never jumps over the surface
        reach[k] = angle
    first = reach.max()
    middle, normal = np.zeros(3), np.zeros(3)
    if first <= 0.0:
        return middle, normal, False
    count = 0
    for k in range(len(face)):
        p = face[k]
        if reach[k] > first - _SAME_CONTACT_M / np.sqrt(p[0] ** 2 + p[2] ** 2):
            x, y, z = _turn(p, reach[k])
            px, py, pz = _at(T, x, y, z)
            nx, ny, nz = normal_at(parts, profiles, px, py, pz)
            middle += np.array([px, py, pz])
            normal += np.array([nx, ny, nz])
            count += 1
    return middle / count, normal / (np.sqrt(np.sum(normal**2)) + 1e-12), True


@njit(cache=True)
def _push_to_stationary_jaw(parts, profiles, T, face, along):
    """Move the stationary jaw along `along` (3,) until it touches; return as `_close`."""
    reach = np.empty(len(face))
    origins = np.empty((len(face), 3))
    for k in range(len(face)):
        px, py, pz = _at(T, face[k, 0], face[k, 1], face[k, 2])
        origins[k] = px, py, pz
        reach[k] = trace(parts, profiles, px, py, pz, along[0], along[1], along[2], _MAX_GAP_M)
    nearest = reach.min()
    middle, normal = np.zeros(3), np.zeros(3)
    if nearest == np.inf:
        return middle, normal, False
    count = 0
    for k in range(len(face)):
        if reach[k] < nearest + _SAME_CONTACT_M:
            p = origins[k] + reach[k] * along
            nx, ny, nz = normal_at(parts, profiles, p[0], p[1], p[2])
            middle += p
            normal += np.array([nx, ny, nz])
            count += 1
    return middle / count, normal / (np.sqrt(np.sum(normal**2)) + 1e-12), True


@njit(cache=True)
def check_z1_grasps(  # noqa: PLR0917
    parts, profiles, T, widths, stationary, moving, stationary_face, moving_face, fit, clearance, cos_cone
):
    """Return free, antipodal, widths and offsets (N,) as a `GraspCheck` holds them.

    The gripper is fitted around the stated `widths` (N,), the stationary jaw just off the surface. The moving jaw
    closes and pushes the object, without turning it, against the stationary one.
    """
    n = len(T)
    free, antipodal = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    contact_widths, offsets = np.full(n, np.nan), np.full(n, np.nan)
    for i in range(n):
        T_object_pivot, opening = _place(T[i], fit, widths[i])
        free[i] = _clear(parts, profiles, T_object_pivot, stationary, 0.0, clearance) and _clear(
            parts, profiles, T_object_pivot, moving, opening, clearance
        )
        if not free[i]:
            continue
        pushed, push_normal, pushes = _close(parts, profiles, T_object_pivot, moving_face, opening)
        if not pushes:
            continue
        y = T[i, :3, 1].copy()
        leant, lean_normal, leans = _push_to_stationary_jaw(parts, profiles, T_object_pivot, stationary_face, y)
        if not leans:
            continue
        contact_widths[i] = np.sum((pushed - leant) * y)
        offsets[i] = np.sum((0.5 * (pushed + leant) - T[i, :3, 3]) * y)
        within_cones = np.sum(push_normal * y) > cos_cone and -np.sum(lean_normal * y) > cos_cone
        antipodal[i] = within_cones and contact_widths[i] > 0.0
    return free, antipodal, contact_widths, offsets
