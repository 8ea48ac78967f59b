"""Maps a parallel-jaw grasp and a width to the Z1's beak: one fixed jaw, one jaw that turns about the pivot's y axis.

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

from hal import z1

STATOR_FACE = np.array(
    [(0.1000, -0.0090), (0.0751, -0.0090), (0.0516, -0.0177), (0.0430, -0.0188), (0.0323, -0.0185), (0.0281, -0.0163)]
)
"""(K, 2) x, z of the fixed jaw's inner face in the pivot frame, tip first [m]; the same over the pad's width."""
MOVER_FACE = np.array(
    [(0.1000, -0.0090), (0.0762, -0.0090), (0.0727, -0.0083), (0.0569, -0.0012), (0.0493, 0.0009), (0.0410, 0.0013)]
)
"""(K, 2) x, z of the moving jaw's inner face in the pivot frame when closed, tip first [m]."""
KNEE_RADIUS_M = 0.0767
"""Distance of both knees from the mover's axis [m]."""
PALM_RADIUS_M = 0.033
"""The palm is a cylinder about the mover's axis; the mover's root reaches 0.5 mm beyond it [m]."""
PAD_HALF_WIDTH_M = 0.026
"""Half the pads' width along the pivot's y at the tips; 0.035 at the knees [m]."""
JAW_REACH_M = 0.100
"""Distance of the fingertips from the pivot [m]."""

_WIDTHS_M = np.arange(0.002, 0.120, 0.0005)
_MOST_PAST = 0.15  # of an object's radius: further, and a thin one would sit behind the knees


class WidthError(ValueError):
    """An object is too wide for the beak, or its width makes no sense."""


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BeakGrasp:
    """One way to lay the beak around an object."""

    T_base_pivot: np.ndarray
    """(4, 4) pivot pose at the grasp, before the jaw closes."""
    jaw_contact: float
    """Mover angle at which both jaws touch an object of that width [rad]."""
    jaw_open: float
    """Mover angle while approaching [rad]."""
    T_base_touch: np.ndarray
    """(4, 4) pivot pose once both jaws press: turned about the jaw's axis, the object where it was."""
    jaw_touch: float
    """Mover angle there [rad]."""
    width_m: float
    """Object width [m]."""
    flipped: bool
    """False: the moving jaw is on the grasp's +y side; True: on its −y side."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BeakBatch:
    """Both ways for many grasps."""

    T_base_pivots: np.ndarray
    """(N, 2, 4, 4) pivot poses; the second is flipped."""
    jaw_contact: np.ndarray
    """(N,) [rad]."""
    jaw_open: np.ndarray
    """(N,) [rad]."""
    T_base_touches: np.ndarray
    """(N, 2, 4, 4) pivot poses once both jaws press."""
    jaw_touch: np.ndarray
    """(N,) [rad]."""
    setback_m: np.ndarray
    """(N,) how far before the asked contacts the object is held, so that the palm stays clear of it [m]."""
    level: np.ndarray
    """(N,) 1 where the squeeze does not push the object out, 0 where friction only just holds it."""
    fits: np.ndarray
    """(N,) False where the width is refused; the other rows of such a grasp mean nothing."""


class BeakGripper:
    """Lays the beak around objects of given width; knows nothing of arm or scene."""

    def __init__(self, config: BeakConfig | None = None) -> None:
        self.config = config or BeakConfig()
        self._steepest = float(np.arctan(self.config.friction))
        fits = self._fits(_lay_around(_WIDTHS_M, 0.5 * _WIDTHS_M, self.config))
        self.max_width_m = float(_WIDTHS_M[fits].max(initial=0.0))
        """Widest round object that is neither squeezed out nor needs more than the full opening [m]."""

    def squeeze_out_angle(self, width_m: float) -> float:
        """Return the angle [rad] friction must make up for at each jaw; negative when the squeeze pulls inwards."""
        width = np.array([width_m])
        return float(_lay_around(width, 0.5 * width, self.config).squeeze_out[0])

    def fit(
        self, T_base_grasp: np.ndarray, width_m: float, front_m: float | None = None
    ) -> tuple[BeakGrasp, BeakGrasp]:
        """Lay the beak around an object of `width_m` at `T_base_grasp` (4, 4), both roll-flips.

        The contact axis runs along the grasp's y, `contact_depth_m` before the origin: there is the middle of a disc
        of diameter `width_m` that both jaws touch. The fingertips pass it by 20 to 26 mm where the object leaves room
        before the palm, and by less where not.

        Args:
            T_base_grasp: (4, 4) the grasp: z approach, y opening, origin midway between a generator's fingertips.
            width_m: object's width along y [m].
            front_m: how far the object reaches from the contact axis towards the palm [m]; half the width if None.

        Raises:
            WidthError: the object is too wide or too deep, or its width is not a positive number.
        """
        front = None if front_m is None else np.array([front_m])
        batch = self.fit_batch(T_base_grasp[None], np.array([width_m]), front)
        if not batch.fits[0]:
            raise WidthError(self.refusal(width_m, front_m))
        one, other = (
            BeakGrasp(
                T_base_pivot=batch.T_base_pivots[0, flip],
                jaw_contact=float(batch.jaw_contact[0]),
                jaw_open=float(batch.jaw_open[0]),
                T_base_touch=batch.T_base_touches[0, flip],
                jaw_touch=float(batch.jaw_touch[0]),
                width_m=float(width_m),
                flipped=bool(flip),
            )
            for flip in range(2)
        )
        return one, other

    def refusal(self, width_m: float, front_m: float | None = None) -> str:
        """Say why an object of `width_m` that reaches `front_m` towards the palm does not fit."""
        if not width_m > 0.0:
            return f"the width is {width_m} m; it must be a positive number."
        deep = "" if front_m is None else f" and reaches {front_m * 1e3:.0f} mm from the contacts towards the palm"
        return (
            f"the object is {width_m * 1e3:.0f} mm wide{deep}; with a friction coefficient of {self.config.friction} "
            f"the beak holds a round one of up to {self.max_width_m * 1e3:.0f} mm, and one that reaches deep into "
            f"the hand up to {self.config.max_setback_m * 1e3:.0f} mm nearer its front than asked."
        )

    def fit_batch(
        self, T_base_grasps: np.ndarray, widths_m: np.ndarray, fronts_m: np.ndarray | None = None
    ) -> BeakBatch:
        """Lay the beak around many objects: grasps (N, 4, 4), widths (N,) and fronts (N,) as in `fit` [m]."""
        usable = (widths_m > 0.0) & (widths_m < _WIDTHS_M[-1])
        widths = np.where(usable, widths_m, 0.05)
        fronts = 0.5 * widths if fronts_m is None else fronts_m
        lay = _lay_around(widths, fronts, self.config)
        T_grasp_pivot = _grasp_to_pivot(lay.centre, lay.tilt)
        T_grasp_pivot[:, 2, 3] -= self.config.contact_depth_m + lay.setback_m
        flip = np.diag([-1.0, -1.0, 1.0, 1.0])
        T_base_pivots = np.stack([T_base_grasps @ T_grasp_pivot, T_base_grasps @ flip @ T_grasp_pivot], axis=1)
        return BeakBatch(
            T_base_pivots=T_base_pivots,
            jaw_contact=-lay.contact,
            jaw_open=np.maximum(-lay.opened, z1.GRIPPER_OPEN),
            T_base_touches=T_base_pivots @ mover_pose(-lay.turn)[:, None],
            jaw_touch=-lay.pressed,
            setback_m=lay.setback_m,
            level=np.clip(1.0 - lay.squeeze_out / self._steepest, 0.0, 1.0),
            fits=usable & self._fits(lay),
        )

    def _fits(self, lay: _Lay) -> np.ndarray:
        held = (lay.squeeze_out <= self._steepest) & (lay.setback_m <= self.config.max_setback_m)
        return held & (lay.opened <= -z1.GRIPPER_OPEN)


def mover_pose(jaw: float | np.ndarray) -> np.ndarray:
    """Return T_pivot_mover (..., 4, 4) at mover angle `jaw` [rad]: a turn about the pivot's y axis."""
    c, s = np.cos(jaw), np.sin(jaw)
    T_pivot_mover = np.zeros((*np.shape(jaw), 4, 4))
    T_pivot_mover[..., 0, 0] = T_pivot_mover[..., 2, 2] = c
    T_pivot_mover[..., 0, 2], T_pivot_mover[..., 2, 0] = s, -s
    T_pivot_mover[..., 1, 1] = T_pivot_mover[..., 3, 3] = 1.0
    return T_pivot_mover


class _Lay(NamedTuple):
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


def _lay_around(widths: np.ndarray, fronts: np.ndarray, config: BeakConfig) -> _Lay:
    r = 0.5 * widths
    knees = np.sqrt(np.maximum(KNEE_RADIUS_M**2 - r**2, 0.0)) - np.minimum(config.knee_past_m, _MOST_PAST * r)
    palm_m = PALM_RADIUS_M + config.palm_clearance_m
    distance = np.maximum(knees, palm_m + np.minimum(fronts, r))
    above, contact = _gap(distance, r)
    centre = _polar(distance, above)
    on_stator = _nearest(STATOR_FACE, centre)
    on_mover = _turned(_nearest(MOVER_FACE, _turned(centre, -contact)), contact)
    across = on_mover - on_stator
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.column_stack([across[:, 1], -across[:, 0]])
    push = np.sum((2.0 * centre - on_stator - on_mover) * along, axis=1)
    above_open, opened = _gap(distance, r + config.clearance_m)
    above_pressed, pressed = _gap(distance, np.maximum(r - 0.5 * config.squeeze_m, 0.0))
    return _Lay(
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
    above, below = _bearing(STATOR_FACE, distance, r, 1.0), _bearing(MOVER_FACE, distance, r, -1.0)
    return above, above - below


def _grasp_to_pivot(centre: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """Return T_grasp_pivot (N, 4, 4) of grasps at `centre` (N, 2) in the pivot's xz plane.

    `tilt` (N,) is their approach's angle from x towards z [rad].
    """
    c, s = np.cos(tilt), np.sin(tilt)
    x, z = centre.T
    T = np.zeros((len(x), 4, 4))
    # Rows are the grasp's axes in the pivot frame: x along the pads' width, y from the fixed jaw to the mover
    T[:, 0, 1] = T[:, 3, 3] = 1.0
    T[:, 1, 0], T[:, 1, 2] = -s, c
    T[:, 2, 0], T[:, 2, 2] = c, s
    T[:, 1, 3] = s * x - c * z
    T[:, 2, 3] = -(c * x + s * z)
    return T


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
