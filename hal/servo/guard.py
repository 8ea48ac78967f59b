"""Safety guard: the arm stays inside a workspace box, above the table, and clear of itself, for every client.

Trajectories are checked point by point before they are queued; single setpoints when they arrive, and again every tick
at the position where the arm would come to rest if it braked now. Numba compiles the margins.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.z1 import CAPSULE_PAIRS, CAPSULES, GRIPPER_OBSTACLES, GRIPPER_POINTS, MOVING_JAW_POINTS, TABLE_LINKS

_LINKS = ("link00", "link01", "link02", "link03", "link04", "link05", "link06")
_LINK = np.array([_LINKS.index(capsule.link) for capsule in CAPSULES])
_ENDS = np.array([(capsule.start, capsule.end) for capsule in CAPSULES])
_RADII = np.array([capsule.radius_m for capsule in CAPSULES])
_MAY_MEET_TABLE = np.array([capsule.link in TABLE_LINKS for capsule in CAPSULES])
_MAY_MEET_GRIPPER = np.array([capsule.link in GRIPPER_OBSTACLES for capsule in CAPSULES])
AXES = "ZYYYZX"
"""Rotation axis of each arm joint in its own frame."""
_ROUNDING_M = 1e-9  # a larger value would let repeated attempts creep outwards
_AXIS = np.array(["XYZ".index(axis) for axis in AXES])


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
def squared_distance(p, a, b):
    """Return the squared distance of point `p` from segment `a` `b`."""
    along, length = 0.0, 0.0
    for i in range(3):
        along += (p[i] - a[i]) * (b[i] - a[i])
        length += (b[i] - a[i]) ** 2
    t = 0.0 if length <= 0.0 else min(max(along / length, 0.0), 1.0)
    total = 0.0
    for i in range(3):
        total += (p[i] - a[i] - t * (b[i] - a[i])) ** 2
    return total


@njit(cache=True, nogil=True)
def segment_distance(a, b, c, d):
    """Return the distance of segments `a` `b` and `c` `d`, neither of them a point (Ericson 2005, section 5.1.9)."""
    uu, vv, uv, uw, vw = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        u, v, w = b[i] - a[i], d[i] - c[i], a[i] - c[i]
        uu, vv, uv, uw, vw = uu + u * u, vv + v * v, uv + u * v, uw + u * w, vw + v * w
    det = uu * vv - uv * uv
    s = min(max((uv * vw - uw * vv) / det, 0.0), 1.0) if det > 1e-12 else 0.0  # parallel: any `s` will do
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
def measure_margins(q, joints, lower, upper, T_flange_pivot):
    """Return the margins of postures, three (N,) arrays [m]: to the box, above z = 0, between links of the arm.

    Args:
        q: (N, 7) postures [rad], writable: a read-only array is another type, which would be compiled again.
        joints: (6, 4, 4) each arm joint's frame in its parent link at angle 0.
        lower: (3,) lower corner of the box, base frame [m].
        upper: (3,) its upper corner [m].
        T_flange_pivot: (4, 4) pose of the moving jaw's hinge.
    """
    n = len(q)
    box, table, own = np.full(n, np.inf), np.full(n, np.inf), np.full(n, np.inf)
    links, unmoved = np.zeros((7, 4, 4)), np.eye(4)
    links[0] = unmoved
    pivot, moving_jaw = np.empty((4, 4)), np.empty((4, 4))
    ends, point = np.empty((len(_RADII), 2, 3)), np.empty(3)
    for k in range(n):
        for j in range(6):
            _chain(links[j], joints[j], _AXIS[j], q[k, j], links[j + 1])
        for c in range(len(_RADII)):
            for e in range(2):
                _apply(links[_LINK[c]], _ENDS[c, e], ends[c, e])
                if _MAY_MEET_TABLE[c]:
                    # The lowest point of a capsule is below one of its ends.
                    table[k] = min(table[k], ends[c, e, 2] - _RADII[c])
        for i in range(len(CAPSULE_PAIRS)):
            one, other = CAPSULE_PAIRS[i, 0], CAPSULE_PAIRS[i, 1]
            gap = segment_distance(ends[one, 0], ends[one, 1], ends[other, 0], ends[other, 1])
            own[k] = min(own[k], gap - _RADII[one] - _RADII[other])
        _chain(links[6], T_flange_pivot, 1, 0.0, pivot)
        _chain(pivot, unmoved, 1, q[k, 6], moving_jaw)  # 1: the moving jaw turns about the pivot's y axis
        for i in range(len(GRIPPER_POINTS) + len(MOVING_JAW_POINTS)):
            if i < len(GRIPPER_POINTS):
                _apply(pivot, GRIPPER_POINTS[i], point)
            else:
                _apply(moving_jaw, MOVING_JAW_POINTS[i - len(GRIPPER_POINTS)], point)
            table[k] = min(table[k], point[2])
            for a in range(3):
                box[k] = min(box[k], point[a] - lower[a], upper[a] - point[a])
            for c in range(len(_RADII)):
                if _MAY_MEET_GRIPPER[c]:
                    own[k] = min(own[k], np.sqrt(squared_distance(point, ends[c, 0], ends[c, 1])) - _RADII[c])
    return box, table, own


@njit(cache=True, nogil=True)
def find_first_outside(q, q_now, joints, lower, upper, T_flange_pivot, allowed):  # noqa: PLR0917 - as `measure_margins`
    """Return index, boundary and margin [m] of the first of the postures `q` (N, 7) that is outside; index −1 if none.

    `allowed` (3,) are the margins that each boundary needs [m]; less is allowed where `q_now` (7,) has less already.
    """
    lowest = np.empty(3)
    for k in range(-1, len(q)):
        box, table, own = measure_margins(
            q_now.reshape(1, 7) if k < 0 else q[k : k + 1], joints, lower, upper, T_flange_pivot
        )
        margins = (box[0], table[0], own[0])
        for i in range(3):
            if k < 0:
                lowest[i] = min(allowed[i], margins[i] - _ROUNDING_M)
            elif margins[i] < lowest[i]:
                return k, i, margins[i]
    return -1, 0, 0.0


_SLACK_M = 1e-3  # an arm at rest on the boundary may be commanded to stay there


@dataclass(frozen=True, slots=True, kw_only=True)
class Workspace:
    """Allowed space of the gripper, in the base frame; the defaults are all that the arm can reach above its table."""

    lower_m: tuple[float, float, float] = (-0.9, -0.9, -0.5)
    """Lower corner of a box for every point of the gripper [m]."""
    upper_m: tuple[float, float, float] = (0.9, 0.9, 1.2)
    """Upper corner [m]."""
    table_m: float = -0.002
    """Minimum height of every point of gripper and links [m]; the base is mounted on z = 0."""
    self_m: float = -0.020
    """Minimum distance between the arm's links in this coarse model [m]: its capsules are up to 10 mm thicker than the
    links, and overlap by 13 mm where the folded arm rests on itself."""

    def __post_init__(self) -> None:
        numbers = (*self.lower_m, *self.upper_m, self.table_m, self.self_m)
        if not np.isfinite(numbers).all() or any(a >= b for a, b in zip(self.lower_m, self.upper_m, strict=True)):
            raise InvalidValueError(
                f"{self} must be finite, and lower_m below upper_m along every axis.", code="invalid_workspace"
            )


class Margins(NamedTuple):
    """Distances of postures to the guard's boundaries; negative is outside."""

    box_m: np.ndarray
    """(N,) from the gripper to the nearest side of the box [m]."""
    table_m: np.ndarray
    """(N,) from the lowest point of gripper and links to the table [m]."""
    self_m: np.ndarray
    """(N,) between the two nearest links of the arm, less the minimum distance [m]."""


class Violation(NamedTuple):
    """A posture outside the guard's boundaries."""

    index: int
    """Index of the posture."""
    code: str
    """Boundary: `workspace`, `table` or `self_collision`; the code of the `GuardError`."""
    text: str
    """Predicate for an error text, with the depth."""


_BOUNDARIES = (
    ("workspace", "moves the gripper {} mm out of the workspace box"),
    ("table", "goes {} mm below the table's plane"),
    ("self_collision", "brings links of the arm {} mm too close to each other"),
)
"""Code and text of each field of `Margins`."""


class Guard:
    """The check of postures against a workspace; it has no state, so any thread may use it."""

    def __init__(self, workspace: Workspace | None = None) -> None:
        self.workspace = workspace or Workspace()
        # Numba takes about a second to load: only a process with a guard waits for it.
        from hal.servo.guard import find_first_outside, measure_margins

        self._measure, self._find = measure_margins, find_first_outside
        self._corners = np.array(self.workspace.lower_m), np.array(self.workspace.upper_m)
        self._joints, self._pivot = _joint_placements(), z1.T_FLANGE_PIVOT
        space = self.workspace
        self._allowed = np.array([0.0, space.table_m, space.self_m]) - _SLACK_M
        q = np.zeros((1, z1.N_JOINTS))
        self.compute_margins(q)  # compiled before anything moves, as the next one
        self.find_violation(q, q[0])

    def compute_margins(self, q: np.ndarray) -> Margins:
        """Return the margins of postures `q` (N, 7) [rad], in some microseconds each."""
        # A writable copy: a read-only array is another type to the compiler, which would compile again in motion.
        q = np.array(q, dtype=np.float64, order="C")
        box, table, own = self._measure(q, self._joints, *self._corners, z1.T_FLANGE_PIVOT)
        space = self.workspace
        return Margins(box, table - space.table_m, own - space.self_m)

    def find_violation(self, q: np.ndarray, q_now: np.ndarray) -> Violation | None:
        """Return the first of the postures `q` (N, 7) that is outside, or None.

        An arm that is outside already, at `q_now` (7,), may move as long as it does not get further out: otherwise it
        could never be brought back.
        """
        postures, now = np.array(q, dtype=np.float64, order="C"), np.array(q_now, dtype=np.float64)
        index, which, margin_m = self._find(postures, now, self._joints, *self._corners, self._pivot, self._allowed)
        if index < 0:
            return None
        code, text = _BOUNDARIES[which]
        allowed_m = self._allowed[which] + _SLACK_M
        return Violation(index, code, text.format(f"{1e3 * (allowed_m - margin_m):.0f}"))


def _joint_placements() -> np.ndarray:
    """Return (6, 4, 4) the pose of each arm joint's frame in its parent link at angle 0 (URDF); it turns about its axis
    of `AXES`."""
    from hal.base.z1_model import joint_placements
    from hal.servo.guard import AXES

    placements, axes = joint_placements()
    assert axes == tuple(AXES), f"the joints turn about {axes}, the compiled guard assumes {AXES}"
    return placements
