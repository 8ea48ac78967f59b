"""The Z1's beak as a hand to train for: one fixed jaw, one that turns, laid around an object by its width.

`pivot` is the frame of the moving jaw's axis: x towards the tips, y along the axis; the stationary jaw lies below (−z). In
the grasp frame y runs from the fixed jaw to the turning one, so this hand is not its own mirror image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numba import njit

from models.diffusion.training.solids import distance_at, normal_at, trace

STATIONARY_FACE = (
    (0.1000, -0.0090),
    (0.0751, -0.0090),
    (0.0516, -0.0177),
    (0.0430, -0.0188),
    (0.0323, -0.0185),
)
"""x, z of the fixed jaw's inner face in the pivot frame, tip first [m]; as in
`z1_runtime/geometry/gripper_geometry.py`, from the collision meshes of the Z1's description."""
MOVING_FACE = (
    (0.1000, -0.0090),
    (0.0762, -0.0090),
    (0.0727, -0.0083),
    (0.0569, -0.0012),
    (0.0493, 0.0009),
    (0.0410, 0.0013),
)
"""x, z of the turning jaw's inner face when the beak is closed, tip first [m]; same source."""
STATIONARY_BACK = (
    (0.100, -0.0248),
    (0.090, -0.0279),
    (0.080, -0.0318),
    (0.065, -0.0352),
    (0.050, -0.0363),
    (0.035, -0.0364),
)
"""x, z of the fixed jaw's outer side [m]; measured from the same meshes."""
MOVING_BACK = ((0.100, 0.0081), (0.090, 0.0129), (0.080, 0.0177), (0.065, 0.0230), (0.050, 0.0257), (0.035, 0.0262))
"""x, z of the turning jaw's outer side when closed [m]; same source."""
HALF_WIDTH = ((0.035, 0.041), (0.060, 0.0391), (0.080, 0.0352), (0.100, 0.0307))
"""x and half the width along y of both jaws [m]; same source."""
PALM_RADIUS_M, PALM_HALF_WIDTH_M = 0.0335, 0.041
"""The palm is a cylinder about the turning jaw's axis; same source."""
WRIST = ((-0.100, -0.030), 0.030)
"""x range and half the height and width of what lies behind the palm [m]; same source."""
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
"""How the opened beak lies around a width: width [m], opening [rad], middle of the object x, z in the pivot frame [m],
tilt of the approach from x [rad]. From `BeakGripper` in `z1_runtime/grasping/beak_gripper.py`; a test
holds the two together."""
CONTACT_DEPTH_M = 0.012
"""How far the grasp's origin lies beyond the middle of the contacts when the beak is laid; same source."""

_SAME_CONTACT_M = 0.0015
_HIT_M = 2e-4
_MAX_GAP_M = 0.025  # the object is pushed no further than this before it leans on the fixed jaw


@dataclass(frozen=True, kw_only=True)
class Z1GripperSpec:
    """A hand whose one jaw turns towards the other, in the grasp frame: z approach, y from the fixed jaw on."""

    name: str
    max_width_m: float = 0.080
    """Widest object that ground truth closes on [m]."""
    min_width_m: float = 0.004
    """Narrowest [m]."""
    min_depth_m: float = 0.007
    """Least distance from the contacts' middle to the grasp's origin in ground truth [m]."""
    max_depth_m: float = 0.017
    """Greatest [m]."""
    friction: float = 0.5
    """Coulomb coefficient that a valid grasp may count on."""
    symmetric: ClassVar[bool] = False
    """Whether the hand looks the same turned over."""

    @cached_property
    def stationary_points(self) -> np.ndarray:
        """(K, 3) points on what does not move, in the pivot frame; they must not touch an object [m]."""
        angle = np.arctan2(-0.0185, 0.0281) - np.linspace(0.0, 1.5 * np.pi, 9)  # from the fixed jaw's root round
        circle = PALM_RADIUS_M * np.column_stack([np.cos(angle), np.sin(angle)])
        palm = [np.column_stack([circle[:, 0], np.full(9, y), circle[:, 1]]) for y in PALM_HALF_WIDTH_M * _ACROSS]
        (back, front), half = WRIST
        wrist = np.array([(x, y, z) for x in (back, front) for y in (-half, half) for z in (-half, 0.0, half)])
        return np.concatenate([_across(STATIONARY_FACE + STATIONARY_BACK), *palm, wrist])

    @cached_property
    def moving_points(self) -> np.ndarray:
        """(K, 3) points on the turning jaw when closed, in the pivot frame [m]."""
        return _across(MOVING_FACE + MOVING_BACK)

    @cached_property
    def stationary_face_points(self) -> np.ndarray:
        """(P, 3) points of the fixed jaw that objects lean on [m]."""
        return _across(_denser(STATIONARY_FACE))

    @cached_property
    def moving_face_points(self) -> np.ndarray:
        """(P, 3) points of the turning jaw that push, when closed [m]."""
        return _across(_denser(MOVING_FACE))


_ACROSS = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])


def _across(outline: tuple[tuple[float, float], ...]) -> np.ndarray:
    """Return points (K, 3) of an outline, five over the jaw's width."""
    x, z = np.array(outline).T
    half = np.interp(x, *np.array(HALF_WIDTH).T)
    return np.concatenate([np.column_stack([x, share * half, z]) for share in _ACROSS])


def _denser(outline: tuple[tuple[float, float], ...], spacing_m: float = 0.006) -> tuple[tuple[float, float], ...]:
    points = np.array(outline)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], round(along[-1] / spacing_m) + 1)
    return tuple(zip(np.interp(at, along, points[:, 0]), np.interp(at, along, points[:, 1]), strict=True))


@njit(cache=True)
def _place(T, fit, width):
    """Return T_object_pivot (4, 4) and the opening [rad] of the beak laid around `width` for the grasp `T`."""
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
    """Return a point of the closed turning jaw when it is opened."""
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
    """Turn the jaw until it touches: return the contact's middle (3,), its normal (3,), and whether there is one."""
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
    """Move the fixed jaw along `along` (3,) until it touches: as `_close`, and how far it moved."""
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
def check_z1_grasps(parts, profiles, T, widths, stationary, moving, stationary_face, moving_face, fit, clearance, cos_cone):  # noqa: PLR0917
    """Return free, antipodal, widths and offsets (N,) as a `GraspCheck` holds them.

    The beak is laid around the stated `widths` (N,), the stationary jaw just beside the surface. The moving jaw closes
    and pushes the object, without turning it, against the fixed one.
    """
    n = len(T)
    free, antipodal = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    seen, offsets = np.full(n, np.nan), np.full(n, np.nan)
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
        seen[i] = np.sum((pushed - leant) * y)
        offsets[i] = np.sum((0.5 * (pushed + leant) - T[i, :3, 3]) * y)
        antipodal[i] = np.sum(push_normal * y) > cos_cone and -np.sum(lean_normal * y) > cos_cone and seen[i] > 0.0
    return free, antipodal, seen, offsets
