"""The Z1's beak in the plane in which it closes: its inner faces, and how they lie around a disc.

Both inner faces were measured from the STL meshes. A jaw is flat for the 24 mm behind its tip (z = −9 mm with the beak
closed), then recedes by about 23° towards the palm. The edge between the two, the *knee*, lies 76.7 mm from the
mover's axis on both jaws. With the beak opened by φ the flats stand φ apart, so they would squeeze an object out like a
wedge; the knees face each other squarely whatever φ is. A grasp therefore puts the knees on the contact axis, the
object midway, and splits φ between the two jaws. Objects wider than 65 mm touch the palm first and sit further out.

Only one jaw moves, so a hand that stands still would shove the object over to the fixed one, and topple what leans.
While the jaw closes the hand therefore turns about the jaw's axis the other way, and both jaws arrive together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from hal.base.z1_gripper import KNEE_RADIUS_M, MOVING_FACE, PALM_RADIUS_M, STATIONARY_FACE

_MOST_PAST = 0.15  # of an object's radius: further, and a thin one would sit behind the knees


@dataclass(frozen=True, slots=True, kw_only=True)
class BeakConfig:
    """How the beak is laid around an object."""

    contact_depth_m: float = 0.012
    """How far the grasp's origin, midway between a generator's fingertips, lies beyond the contacts: half of what
    generators reach past them. The beak's own tips then pass the contacts by some 20 mm [m]."""
    knee_past_m: float = 0.003
    """How far the knees go beyond the contact axis along the approach; a little beyond pulls the object in [m]."""
    max_setback_m: float = 0.025
    """How far before the asked contacts an object that reaches deep into the hand may be held instead [m]."""
    unseen_m: float = 0.004
    """How much farther out than said a contact is thought to be that the camera does not see: generators take what
    they cannot see for less than it is [m]."""
    max_deepening_m: float = 0.010
    """How far beyond the asked contacts an object is held that reaches less far towards the palm than a round one of
    its width: it is wider there [m]."""
    palm_clearance_m: float = 0.005
    """Free space between the palm and the object [m]."""
    clearance_m: float = 0.0095
    """Gap between each jaw and the object while approaching; opening wider makes tilted objects collide [m]."""
    squeeze_m: float = 0.016
    """How much narrower than the object the gap is where the hand stops turning; the jaw closes on from there. So the
    jaws are at their fastest when they touch, and an error of the middle costs least time between the two [m]."""
    friction: float = 0.4
    """Least friction coefficient that must keep the object from being squeezed out; rubber on plastic has 0.5 to 1."""


class Lay(NamedTuple):
    """How the beak lies around N discs, in the pivot's xz plane."""

    contact: np.ndarray
    """(N,) opening at which both jaws touch [rad]."""
    opened: np.ndarray
    """(N,) opening that leaves the clearances [rad]."""
    pressed: np.ndarray
    """(N,) opening at which the gap is narrower by the squeeze [rad]."""
    turn: np.ndarray
    """(N,) how far the hand turns about the mover's axis while the jaw goes from `opened` to `pressed` [rad]."""
    centre: np.ndarray
    """(N, 2) the disc's middle while the jaw is opened [m]."""
    tilt: np.ndarray
    """(N,) angle of the approach axis from x towards z while the jaw is opened [rad]."""
    squeeze_out: np.ndarray
    """(N,) half the angle between the two contacts' pushes, positive outwards [rad]."""
    setback_m: np.ndarray
    """(N,) how far before the contact axis the disc lies, so that the palm stays clear of the object [m]."""


def lay_around(widths: np.ndarray, fronts: np.ndarray, config: BeakConfig) -> Lay:
    """Return how the beak lies around discs `widths` (N,) wide that reach `fronts` (N,) towards the palm [m]."""
    r = 0.5 * widths
    knees = np.sqrt(np.maximum(KNEE_RADIUS_M**2 - r**2, 0.0)) - np.minimum(config.knee_past_m, _MOST_PAST * r)
    palm_m = PALM_RADIUS_M + config.palm_clearance_m
    distance = np.maximum(knees, palm_m + np.minimum(fronts, r))
    above, contact = _gap(distance, r)
    centre = _polar(distance, above)
    on_stator = _nearest(STATIONARY_FACE, centre)
    on_mover = _turned(_nearest(MOVING_FACE, _turned(centre, -contact)), contact)
    across = on_mover - on_stator
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.column_stack([across[:, 1], -across[:, 0]])
    push = np.sum((2.0 * centre - on_stator - on_mover) * along, axis=1)
    above_open, opened = _gap(distance, r + config.clearance_m)
    above_pressed, pressed = _gap(distance, np.maximum(r - 0.5 * config.squeeze_m, 0.0))
    return Lay(
        contact=contact,
        opened=opened,
        pressed=pressed,
        turn=above_open - above_pressed,
        centre=_polar(distance, above_open),
        tilt=np.arctan2(along[:, 1], along[:, 0]) + above_open - above,
        squeeze_out=np.arctan2(push, widths),
        # What reaches further towards the palm than it is thick is held where there is room, nearer its front
        setback_m=np.maximum(knees, palm_m + fronts) - distance,
    )


def _gap(distance: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where discs at `distance` (N,) that touch both jaws lie above the pivot's x (N,), and the opening (N,)."""
    above, below = _bearing(STATIONARY_FACE, distance, r, 1.0), _bearing(MOVING_FACE, distance, r, -1.0)
    return above, above - below


@njit(cache=True)
def _bearing(face, distance, r, side):
    """Return the angles (N,) [rad] of discs' middles, at `distance` (N,) from the axis, that just touch `face`.

    `side` is +1 when the disc lies above the face, −1 below. The gap grows with the angle: bisection finds it.
    """
    on_face = np.arctan2(face[1, 1], face[1, 0])
    bearings = np.empty(len(r))
    for n in range(len(r)):
        low, high = 0.0, 0.5 * np.pi
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
    least = np.inf
    for k in range(len(face) - 1):
        dx, dz = face[k + 1, 0] - face[k, 0], face[k + 1, 1] - face[k, 1]
        t = ((x - face[k, 0]) * dx + (z - face[k, 1]) * dz) / (dx * dx + dz * dz)
        t = min(max(t, 0.0), 1.0)
        least = min(least, (face[k, 0] + t * dx - x) ** 2 + (face[k, 1] + t * dz - z) ** 2)
    return least


def _polar(distance: np.ndarray, angle: np.ndarray) -> np.ndarray:
    return np.column_stack([distance * np.cos(angle), distance * np.sin(angle)])


def _turned(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
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
