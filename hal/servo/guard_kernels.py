"""Margins of the safety guard, compiled by Numba."""

from __future__ import annotations

import numpy as np
from numba import njit

from hal.base.z1_shape import CAPSULE_PAIRS, CAPSULES, GRIPPER_OBSTACLES, GRIPPER_POINTS, MOVING_JAW_POINTS, TABLE_LINKS

_LINKS = ("link00", "link01", "link02", "link03", "link04", "link05", "link06")
_LINK = np.array([_LINKS.index(capsule.link) for capsule in CAPSULES])
_ENDS = np.array([(capsule.start, capsule.end) for capsule in CAPSULES])
_RADII = np.array([capsule.radius_m for capsule in CAPSULES])
_MAY_MEET_TABLE = np.array([capsule.link in TABLE_LINKS for capsule in CAPSULES])
_MAY_MEET_GRIPPER = np.array([capsule.link in GRIPPER_OBSTACLES for capsule in CAPSULES])
AXES = "ZYYYZX"
"""Rotation axis of each arm joint in its own frame."""
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
