"""Where the arm may be, whoever commands it: inside a box, above the table, and clear of itself.

Trajectories are checked point by point before they are queued; single setpoints when they are taken, and again every
tick at the place where the arm would come to rest if it braked now.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from hal import z1
from hal.z1_shape import CAPSULE_PAIRS, CAPSULES, GRIPPER_OBSTACLES, HAND_POINTS, MOVER_POINTS, TABLE_LINKS

_LINKS = ("link00", "link01", "link02", "link03", "link04", "link05", "link06")
_SLACK_M = 1e-3  # an arm that rests on the edge may be told to stay there
_ROUNDING_M = 1e-9  # more, and repeated attempts would creep outwards
_LINK = np.array([_LINKS.index(capsule.link) for capsule in CAPSULES])
_ENDS = np.array([(capsule.start, capsule.end) for capsule in CAPSULES])
_RADII = np.array([capsule.radius_m for capsule in CAPSULES])
_MAY_MEET_TABLE = np.array([capsule.link in TABLE_LINKS for capsule in CAPSULES])
_MAY_MEET_HAND = np.array([capsule.link in GRIPPER_OBSTACLES for capsule in CAPSULES])


@dataclass(frozen=True, slots=True, kw_only=True)
class Workspace:
    """Where the hand may be, in the base frame; the defaults leave the arm all it can reach above its own table."""

    lower_m: tuple[float, float, float] = (-0.9, -0.9, -0.5)
    """Lower corner of a box for every point of the hand [m]."""
    upper_m: tuple[float, float, float] = (0.9, 0.9, 1.2)
    """Upper corner [m]."""
    table_m: float = -0.002
    """No point of hand or links goes below this height [m]; the base stands on z = 0."""
    self_m: float = -0.020
    """Least distance between the arm's parts, as this coarse model has them [m]: its capsules are up to 10 mm fatter
    than the links, and overlap by 13 mm where the folded arm rests on itself."""

    def __post_init__(self) -> None:
        numbers = (*self.lower_m, *self.upper_m, self.table_m, self.self_m)
        if not np.isfinite(numbers).all() or any(a >= b for a, b in zip(self.lower_m, self.upper_m, strict=True)):
            raise ValueError(f"{self} must be finite, and lower_m below upper_m along every axis.")


class Margins(NamedTuple):
    """How far postures stay inside what is allowed; negative is outside."""

    box_m: np.ndarray
    """(N,) from the hand to the nearest side of the box [m]."""
    table_m: np.ndarray
    """(N,) from the lowest point of hand and links to the table [m]."""
    self_m: np.ndarray
    """(N,) between the two nearest parts of the arm, beyond the least distance [m]."""


_WHAT = (
    "takes the hand {} mm out of the workspace box",
    "goes {} mm below the table's plane",
    "brings parts of the arm {} mm too near to each other",
)


class Guard:
    """Knows the arm's kinematics and shape; holds no state, so any thread may ask it."""

    def __init__(self, workspace: Workspace | None = None) -> None:
        self.workspace = workspace or Workspace()
        self._corners = np.array(self.workspace.lower_m), np.array(self.workspace.upper_m)
        self._joints = _joint_placements()
        self.margins(np.zeros((1, z1.N_JOINTS)))  # compiled before anything moves

    def margins(self, q: np.ndarray) -> Margins:
        """Return how far postures `q` (N, 7) [rad] stay inside; some microseconds each."""
        # A copy, writable: a read-only array is another type to the compiler, which would compile again in motion.
        q = np.array(q, dtype=np.float64, order="C")
        box, table, own = _margins(q, self._joints, *self._corners, z1.T_FLANGE_PIVOT)
        space = self.workspace
        return Margins(box, table - space.table_m, own - space.self_m)

    def refusal(self, q: np.ndarray, q_now: np.ndarray) -> tuple[int, str] | None:
        """Return the first of `q` (N, 7) that is outside and why, or None.

        An arm that is outside already, at `q_now` (7,), may move as long as it does not get further out: else it
        could never be brought back.
        """
        now, asked = self.margins(q_now[None]), self.margins(q)
        worst: tuple[int, str] | None = None
        for here, there, what in zip(now, asked, _WHAT, strict=True):
            outside = np.flatnonzero(there < min(-_SLACK_M, float(here[0]) - _ROUNDING_M))
            if len(outside) and (worst is None or outside[0] < worst[0]):
                first = int(outside[0])
                worst = first, what.format(f"{-1e3 * there[first]:.0f}")
        return worst


def _joint_placements() -> np.ndarray:
    """Return (6, 4, 4) the pose of each arm joint's frame in its parent link at angle 0 (URDF); it turns about its axis
    of `_AXES`."""
    import pinocchio as pin  # pyright: ignore[reportMissingImports] - a .pth file leads to it

    model = pin.buildModelFromUrdf(str(z1.urdf_path()))
    placements = np.empty((z1.N_ARM, 4, 4))
    for n in range(z1.N_ARM):
        joint = model.getJointId(z1.JOINT_NAMES[n])
        axis = model.joints[joint].shortname()[-1]
        assert axis == _AXES[n], f"{z1.JOINT_NAMES[n]} turns about {axis}"
        placements[n] = model.jointPlacements[joint].homogeneous
    return placements


_AXES = "ZYYYZX"
_AXIS = np.array(["XYZ".index(axis) for axis in _AXES])


@njit(cache=True, nogil=True)
def _chain(T, joint, axis, angle, out):
    """Write `T` @ `joint`, turned about its own axis, to `out`; all (4, 4)."""
    for r in range(3):
        for c in range(4):
            out[r, c] = T[r, 0] * joint[0, c] + T[r, 1] * joint[1, c] + T[r, 2] * joint[2, c]
        out[r, 3] += T[r, 3]
    i, j = (axis + 1) % 3, (axis + 2) % 3
    cos, sin = np.cos(angle), np.sin(angle)
    for r in range(3):
        u, v = out[r, i], out[r, j]
        out[r, i], out[r, j] = cos * u + sin * v, cos * v - sin * u


@njit(cache=True, nogil=True)
def _apply(T, p, out):
    for r in range(3):
        out[r] = T[r, 0] * p[0] + T[r, 1] * p[1] + T[r, 2] * p[2] + T[r, 3]


@njit(cache=True, nogil=True)
def _point_distance(p, a, b):
    """Return the distance of point `p` from segment `a` `b`."""
    along, length = 0.0, 0.0
    for i in range(3):
        along += (p[i] - a[i]) * (b[i] - a[i])
        length += (b[i] - a[i]) ** 2
    t = 0.0 if length <= 0.0 else min(max(along / length, 0.0), 1.0)
    total = 0.0
    for i in range(3):
        total += (p[i] - a[i] - t * (b[i] - a[i])) ** 2
    return np.sqrt(total)


@njit(cache=True, nogil=True)
def _segment_distance(a, b, c, d):
    """Return the distance of segments `a` `b` and `c` `d`, neither of them a point (Ericson 2005, section 5.1.9)."""
    uu, vv, uv, uw, vw = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        u, v, w = b[i] - a[i], d[i] - c[i], a[i] - c[i]
        uu, vv, uv, uw, vw = uu + u * u, vv + v * v, uv + u * v, uw + u * w, vw + v * w
    det = uu * vv - uv * uv
    s = min(max((uv * vw - uw * vv) / det, 0.0), 1.0) if det > 1e-12 else 0.0
    t = (uv * s + vw) / vv
    if t < 0.0:
        t, s = 0.0, min(max(-uw / uu, 0.0), 1.0)
    elif t > 1.0:
        t, s = 1.0, min(max((uv - uw) / uu, 0.0), 1.0)
    total = 0.0
    for i in range(3):
        total += (a[i] - c[i] + s * (b[i] - a[i]) - t * (d[i] - c[i])) ** 2
    return np.sqrt(total)


@njit(cache=True, nogil=True)
def _margins(q, joints, lower, upper, T_flange_pivot):
    n = len(q)
    box, table, own = np.full(n, np.inf), np.full(n, np.inf), np.full(n, np.inf)
    links, unmoved = np.zeros((7, 4, 4)), np.eye(4)
    links[0] = unmoved
    pivot, mover = np.empty((4, 4)), np.empty((4, 4))
    ends, point = np.empty((len(_RADII), 2, 3)), np.empty(3)
    for k in range(n):
        for j in range(6):
            _chain(links[j], joints[j], _AXIS[j], q[k, j], links[j + 1])
        for c in range(len(_RADII)):
            for e in range(2):
                _apply(links[_LINK[c]], _ENDS[c, e], ends[c, e])
                if _MAY_MEET_TABLE[c]:
                    table[k] = min(table[k], ends[c, e, 2] - _RADII[c])
        for i in range(len(CAPSULE_PAIRS)):
            one, other = CAPSULE_PAIRS[i, 0], CAPSULE_PAIRS[i, 1]
            gap = _segment_distance(ends[one, 0], ends[one, 1], ends[other, 0], ends[other, 1])
            own[k] = min(own[k], gap - _RADII[one] - _RADII[other])
        _chain(links[6], T_flange_pivot, 1, 0.0, pivot)
        _chain(pivot, unmoved, 1, q[k, 6], mover)
        for i in range(len(HAND_POINTS) + len(MOVER_POINTS)):
            if i < len(HAND_POINTS):
                _apply(pivot, HAND_POINTS[i], point)
            else:
                _apply(mover, MOVER_POINTS[i - len(HAND_POINTS)], point)
            table[k] = min(table[k], point[2])
            for a in range(3):
                box[k] = min(box[k], point[a] - lower[a], upper[a] - point[a])
            for c in range(len(_RADII)):
                if _MAY_MEET_HAND[c]:
                    own[k] = min(own[k], _point_distance(point, ends[c, 0], ends[c, 1]) - _RADII[c])
    return box, table, own
