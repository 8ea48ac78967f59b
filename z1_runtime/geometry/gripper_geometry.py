"""Fit of the Z1's jaws around a disc, in the plane in which they close.

Both inner faces (`hal.base.z1_shape`) are flat for the 24 mm behind the tip (z = −9 mm with the jaws closed), then
recede by about 23° towards the palm. The edge between the two parts, the *knee*, is 76.7 mm from the moving jaw's axis
on both jaws. At an opening φ the flats are φ apart and would squeeze an object out like a wedge; the knees face each
other squarely at every φ. A grasp therefore puts the knees on the contact axis, the object midway, and splits φ between
the two jaws. Objects wider than 65 mm touch the palm first and are held further out.

Only one jaw moves, so a gripper at rest would push the object towards the stationary one, and topple a leaning object.
While the jaw closes the gripper therefore turns about the jaw's axis the other way, and both jaws arrive together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from hal.base.z1_shape import KNEE_RADIUS_M, MOVING_FACE, PALM_RADIUS_M, STATIONARY_FACE

_MAX_PAST_RATIO = 0.15  # of an object's radius: beyond it, a thin object would be behind the knees


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperPlacementConfig:
    """Placement of the gripper around an object."""

    contact_depth_m: float = 0.012
    """Distance of the grasp's origin, midway between a generator's fingertips, beyond the contacts: half of the reach
    of generators past them. The Z1's own tips then pass the contacts by some 20 mm [m]."""
    knee_past_m: float = 0.003
    """Distance of the knees beyond the contact axis along the approach; a little beyond pulls the object in [m]."""
    max_setback_m: float = 0.025
    """Maximum distance before the requested contacts at which an object that reaches the palm is held instead [m]."""
    occluded_margin_m: float = 0.004
    """Margin added to contacts on the occluded side: generators underestimate what the camera cannot see [m]."""
    max_deepening_m: float = 0.010
    """Maximum distance beyond the requested contacts at which an object is held that reaches less far towards the palm
    than a round one of its width: it is wider there [m]."""
    palm_clearance_m: float = 0.005
    """Free space between the palm and the object [m]."""
    clearance_m: float = 0.0095
    """Gap between each jaw and the object while approaching; opening wider makes tilted objects collide [m]."""
    squeeze_m: float = 0.016
    """Width of the object minus the gap at which the gripper stops turning; from there the jaw closes alone. The jaws
    are thus at their fastest when they touch, and an error of the centre delays the second contact least [m]."""
    friction: float = 0.4
    """Minimum friction coefficient that must hold the object against the wedge; rubber on plastic has 0.5 to 1."""


class JawFit(NamedTuple):
    """The jaws around N discs, in the pivot's xz plane."""

    contact: np.ndarray
    """(N,) opening at which both jaws touch [rad]."""
    opened: np.ndarray
    """(N,) opening that leaves the clearances [rad]."""
    pressed: np.ndarray
    """(N,) opening at which the gap is narrower by the squeeze [rad]."""
    turn: np.ndarray
    """(N,) turn of the gripper about the moving jaw's axis while the jaw goes from `opened` to `pressed` [rad]."""
    centre: np.ndarray
    """(N, 2) the disc's centre while the jaw is opened [m]."""
    tilt: np.ndarray
    """(N,) angle of the approach axis from x towards z while the jaw is opened [rad]."""
    squeeze_out: np.ndarray
    """(N,) half the angle between the two contacts' pushes, positive outwards [rad]."""
    setback_m: np.ndarray
    """(N,) distance of the disc before the contact axis, so that the palm stays clear of the object [m]."""


def fit_jaws(widths: np.ndarray, fronts: np.ndarray, config: GripperPlacementConfig) -> JawFit:
    """Return the jaws around discs of `widths` (N,) that reach `fronts` (N,) towards the palm [m]."""
    r = 0.5 * widths
    knees = np.sqrt(np.maximum(KNEE_RADIUS_M**2 - r**2, 0.0)) - np.minimum(config.knee_past_m, _MAX_PAST_RATIO * r)
    palm_m = PALM_RADIUS_M + config.palm_clearance_m
    # Objects wider than 65 mm touch the palm before the knees
    distance = np.maximum(knees, palm_m + np.minimum(fronts, r))
    above, contact = _gap(distance, r)
    centre = _polar(distance, above)
    on_stationary = _nearest(STATIONARY_FACE, centre)
    on_moving = _rotate(_nearest(MOVING_FACE, _rotate(centre, -contact)), contact)
    across = on_moving - on_stationary
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.column_stack([across[:, 1], -across[:, 0]])
    push = np.sum((2.0 * centre - on_stationary - on_moving) * along, axis=1)
    above_open, opened = _gap(distance, r + config.clearance_m)
    # Half of the squeeze on each jaw; thinner objects end with the jaws closed
    above_pressed, pressed = _gap(distance, np.maximum(r - 0.5 * config.squeeze_m, 0.0))
    return JawFit(
        contact=contact,
        opened=opened,
        pressed=pressed,
        turn=above_open - above_pressed,
        centre=_polar(distance, above_open),
        tilt=np.arctan2(along[:, 1], along[:, 0]) + above_open - above,
        squeeze_out=np.arctan2(push, widths),
        # An object that reaches further towards the palm than it is thick is held nearer its front
        setback_m=np.maximum(knees, palm_m + fronts) - distance,
    )


def _gap(distance: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bearings (N,) above the pivot's x of discs at `distance` (N,) on both jaws, and the opening (N,)."""
    above, below = _bearing(STATIONARY_FACE, distance, r, 1.0), _bearing(MOVING_FACE, distance, r, -1.0)
    return above, above - below


@njit(cache=True)
def _bearing(face, distance, r, side):
    """Return the angles (N,) [rad] of discs' centres, at `distance` (N,) from the axis, that just touch `face`.

    `side` is +1 for a disc above the face, −1 below. The gap grows with the angle: bisection finds it.
    """
    on_face = np.arctan2(face[1, 1], face[1, 0])
    bearings = np.empty(len(r))
    for n in range(len(r)):
        low, high = 0.0, 0.5 * np.pi
        # 22 halvings of 90° leave 4e-7 rad, or 0.03 µm at the knees
        for _ in range(22):
            middle = 0.5 * (low + high)
            angle = on_face + side * middle
            x, z = distance[n] * np.cos(angle), distance[n] * np.sin(angle)
            if _squared_gap(face, x, z) < r[n] * r[n]:
                low = middle
            else:
                high = middle
        bearings[n] = on_face + side * high
    return bearings


@njit(cache=True)
def _squared_gap(face, x, z):
    """Return the squared distance of (x, z) from polyline `face` (K, 2)."""
    minimum = np.inf
    for k in range(len(face) - 1):
        dx, dz = face[k + 1, 0] - face[k, 0], face[k + 1, 1] - face[k, 1]
        t = ((x - face[k, 0]) * dx + (z - face[k, 1]) * dz) / (dx * dx + dz * dz)
        t = min(max(t, 0.0), 1.0)
        minimum = min(minimum, (face[k, 0] + t * dx - x) ** 2 + (face[k, 1] + t * dz - z) ** 2)
    return minimum


def _polar(distance: np.ndarray, angle: np.ndarray) -> np.ndarray:
    return np.column_stack([distance * np.cos(angle), distance * np.sin(angle)])


def _rotate(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    x, z = points.T
    return np.column_stack([c * x - s * z, s * x + c * z])


def _nearest(face: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the points (N, 2) of polyline `face` (K, 2) nearest to `points` (N, 2)."""
    start, step = face[:-1], np.diff(face, axis=0)
    t = np.sum((points[:, None] - start) * step, axis=2) / np.sum(step * step, axis=1)
    feet = start + np.clip(t, 0.0, 1.0)[..., None] * step
    best = np.sum((feet - points[:, None]) ** 2, axis=2).argmin(axis=1)
    return feet[np.arange(len(points)), best]
