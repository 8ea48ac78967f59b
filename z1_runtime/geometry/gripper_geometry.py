"""Fit of the Z1's jaws around a disc, in the plane in which they close.

Both inner faces (`hal.base.z1`) are flat for the 24 mm behind the tip (z = −9 mm with the jaws closed), then
recede by about 23° towards the palm. The edge between the two parts, the *knee*, is 76.7 mm from the moving jaw's axis
on both jaws. At an opening φ the flats are φ apart and would squeeze an object out like a wedge; the knees face each
other squarely at every φ. A grasp therefore puts the knees on the contact axis, the object midway, and splits φ between
the two jaws. Objects wider than 65 mm touch the palm first and are held further out.

Only one jaw moves, so a gripper at rest would push the object towards the stationary one, and topple a leaning object.
While the jaw closes the gripper therefore turns about the jaw's axis the other way, and both jaws arrive together.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numba import njit

from hal.base import z1
from hal.base.transforms import transform_points
from hal.base.z1 import KNEE_RADIUS_M, MOVING_FACE, PALM_RADIUS_M, STATIONARY_FACE, T_PIVOT_STATIONARY_JAW

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


_SPACING_M = 0.0085
_JAW_SPACING_M = 0.005  # jaws pass the object within millimetres, and its edges must not fit between two points


@dataclass(frozen=True, slots=True, eq=False)
class GripperShape:
    """Even surface points of everything on the wrist, in an order of which every head is spread over the whole."""

    fixed: np.ndarray
    """(V, 3) wrist, stationary jaw, camera and bracket, in the pivot frame [m]."""
    moving_jaw: np.ndarray
    """(V, 3) moving jaw, in its own frame: the pivot frame at jaw angle 0 [m]."""

    def __len__(self) -> int:
        return len(self.fixed) + len(self.moving_jaw)


@cache
def gripper_shape(spacing_m: float = _SPACING_M) -> GripperShape:
    """Return the points, sampled from the STL meshes about `spacing_m` apart [m], closer on the jaws."""
    T_pivot_flange = np.linalg.inv(z1.T_FLANGE_PIVOT)
    stator = transform_points(T_PIVOT_STATIONARY_JAW, _mesh_surface("z1_GripperStator", spacing_m))
    jaw = transform_points(T_PIVOT_STATIONARY_JAW, _mesh_surface("z1_GripperStator", _JAW_SPACING_M))
    stator = np.concatenate([stator[stator[:, 0] < PALM_RADIUS_M], jaw[jaw[:, 0] >= PALM_RADIUS_M]])
    # The housing is hollow; nothing gets inside without crossing its surface
    inside = (np.hypot(stator[:, 0], stator[:, 2]) < PALM_RADIUS_M - 0.002) & (np.abs(stator[:, 1]) < 0.026)
    wrist = transform_points(T_pivot_flange, _mesh_surface("z1_Link06", spacing_m))
    camera = transform_points(
        T_pivot_flange @ z1.T_FLANGE_CAMERA, _box_surface(z1.CAMERA_HOUSING_LOW, z1.CAMERA_HOUSING_HIGH, spacing_m)
    )
    bracket = transform_points(T_pivot_flange, _bracket(spacing_m))
    fixed = np.concatenate([stator[~inside], wrist, camera, bracket])
    moving_jaw = _mesh_surface("z1_GripperMover", _JAW_SPACING_M)
    shape = GripperShape(fixed=spread_first(fixed), moving_jaw=spread_first(moving_jaw))
    # The cache gives the same arrays to every caller
    shape.fixed.setflags(write=False)
    shape.moving_jaw.setflags(write=False)
    return shape


def spread_first(vertices: np.ndarray) -> np.ndarray:
    """Return `vertices` (V, 3) reordered so that any head of the list is spread over the whole: hits come early."""
    # Seeded: which point is hit first is part of a rejection's text
    order = np.random.default_rng(0).permutation(len(vertices))
    return vertices[order]


def _mesh_surface(name: str, spacing_m: float) -> np.ndarray:
    """Return surface points of a mesh: many random ones, thinned to one per voxel (the one nearest its middle)."""
    import trimesh

    mesh = trimesh.load_mesh(z1.mesh_dir() / "collision" / f"{name}.STL")
    # 40 samples for each face of a voxel leave hardly any voxel of the surface empty
    n_dense = int(40.0 * mesh.area / spacing_m**2)
    dense = np.asarray(trimesh.sample.sample_surface(mesh, n_dense, seed=0)[0])
    return _thinned(dense, spacing_m)


def _thinned(dense: np.ndarray, spacing_m: float) -> np.ndarray:
    voxel = np.floor(dense / spacing_m)
    off_centre = np.sum((dense / spacing_m - voxel - 0.5) ** 2, axis=1)
    order = np.argsort(off_centre, kind="stable")
    _, first = np.unique(voxel[order], axis=0, return_index=True)
    return dense[order[first]]


def _box_surface(low: np.ndarray, high: np.ndarray, spacing_m: float) -> np.ndarray:
    """Return a grid over the six faces of an axis-aligned box."""
    counts = np.maximum(np.ceil((high - low) / spacing_m).astype(int) + 1, 2)
    axes = [np.linspace(low[a], high[a], counts[a]) for a in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    on_surface = (np.isclose(grid, low) | np.isclose(grid, high)).any(axis=1)
    return grid[on_surface]


def _bracket(spacing_m: float) -> np.ndarray:
    """Return a grid over the plate between wrist and camera, in the flange frame."""
    rise, half_width = z1.BRACKET_HEAD - z1.BRACKET_FOOT, z1.BRACKET_HALF_WIDTH_M
    along = np.linspace(0.0, 1.0, int(np.ceil(np.linalg.norm(rise) / spacing_m)) + 1)[:, None, None]
    across = np.linspace(-half_width, half_width, int(np.ceil(2.0 * half_width / spacing_m)) + 1)[None, :, None]
    return (z1.BRACKET_FOOT + along * rise + across * np.array([0.0, 0.0, 1.0])).reshape(-1, 3)
