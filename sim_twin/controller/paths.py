"""Joint paths of the controller's own motions: through joint space, along a line, along an arc.

The vendor's profiles are not published. These have minimum jerk from rest to rest, keep the requested speed, and stay
within the joints' limits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from hal.base import z1
from hal.base.transforms import make_pose
from hal.base.z1_kinematics import PivotKinematics, pose_from_posture

MIN_DURATION_S = 0.02
"""Minimum duration of a motion [s], so that every state appears in some answer to a 500 Hz client."""

# Of the minimum-jerk profile s = 10u³ − 15u⁴ + 6u⁵ over unit length and time.
_PEAK_SPEED, _PEAK_ACCELERATION = 1.875, 5.7735
_STEP_M, _STEP_RAD, _MAX_STEPS = 0.01, 0.04, 200
_TURN_SPEED = 1.0  # [rad/s]; the vendor's was not measured
# Maximum change of a joint between two solutions [rad]: a larger one jumps to another branch.
_MAX_CHANGE_RAD = 0.5
_MIN_TRIANGLE_M2 = 1e-6


class _Curve(NamedTuple):
    """Path of the pivot over a parameter from 0 to 1."""

    position: Callable[[float], np.ndarray]
    rotation: Slerp
    length_m: float


class JointPath:
    """Joint positions over time.

    Args:
        points: (N, 7) joint positions [rad], N ≥ 2, evenly spaced over the path.
        duration_s: duration [s].
        recorded: whether the points are a recording, replayed at its own speed; else it runs from rest to rest.
    """

    def __init__(self, points: np.ndarray, duration_s: float, *, recorded: bool = False) -> None:
        self.duration_s = duration_s
        self._recorded = recorded
        self._spline = CubicSpline(np.linspace(0.0, 1.0, len(points)), points)
        self._slope = self._spline.derivative()

    def sample(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (7,) [rad] and speeds (7,) [rad/s] at `t_s` [s], the end's at and after the end."""
        u = min(t_s / self.duration_s, 1.0)
        if u >= 1.0:
            return self._spline(1.0), np.zeros(z1.N_JOINTS)
        if self._recorded:
            return self._spline(u), self._slope(u) / self.duration_s
        s, rate = u**3 * (10.0 - 15.0 * u + 6.0 * u**2), 30.0 * (u * (1.0 - u)) ** 2
        return self._spline(s), self._slope(s) * rate / self.duration_s


def plan_joint_path(start: np.ndarray, goal: np.ndarray, max_speed: float) -> JointPath:
    """Return the path from `start` (7,) to `goal` (7,) [rad], no joint faster than `max_speed` [rad/s] (above 0)."""
    points = np.array([start, goal])
    return JointPath(points, _duration(points, max_speed))


def plan_line_path(
    kinematics: PivotKinematics, start: np.ndarray, posture: np.ndarray, gripper: float, speed: float
) -> JointPath | None:
    """Return the path from `start` (7,) [rad] that moves the pivot straight to `posture` (6,) at up to `speed` [m/s]
    (above 0), and the gripper to `gripper` [rad]; None when a part of it is unreachable."""
    first, last = kinematics.forward(start[: z1.N_ARM]), pose_from_posture(posture)
    rotation = Slerp([0.0, 1.0], Rotation.from_matrix([first[:3, :3], last[:3, :3]]))
    step = last[:3, 3] - first[:3, 3]
    curve = _Curve(lambda u: first[:3, 3] + u * step, rotation, float(np.linalg.norm(step)))
    return _solve_curve(kinematics, start, gripper, speed, curve)


def plan_arc_path(
    kinematics: PivotKinematics, start: np.ndarray, postures: np.ndarray, gripper: float, speed: float
) -> JointPath | None:
    """Return the path along the circle through the pivot's present position and `postures` (2, 6), ending in the
    second; None when a part of it is unreachable, or when the three are collinear."""
    poses = [kinematics.forward(start[: z1.N_ARM]), *(pose_from_posture(posture) for posture in postures)]
    a, b, c = (pose[:3, 3] for pose in poses)
    normal = np.cross(b - a, c - a)
    size = float(np.linalg.norm(normal))
    if size < _MIN_TRIANGLE_M2:
        return None
    ab, ac = b - a, c - a
    # Circumcentre of the triangle a, b, c
    centre = a + (np.cross(normal, ab) * (ac @ ac) + np.cross(ac, normal) * (ab @ ab)) / (2.0 * size**2)
    radius = float(np.linalg.norm(a - centre))
    x_axis = (a - centre) / radius
    y_axis = np.cross(normal / size, x_axis)
    middle, end = (float(np.arctan2((p - centre) @ y_axis, (p - centre) @ x_axis)) % (2 * np.pi) for p in (b, c))
    # The middle posture belongs to where the arc passes its point, not to half of the arc
    rotation = Slerp([0.0, middle / end, 1.0], Rotation.from_matrix([pose[:3, :3] for pose in poses]))

    def position(u: float) -> np.ndarray:
        return centre + radius * (np.cos(u * end) * x_axis + np.sin(u * end) * y_axis)

    return _solve_curve(kinematics, start, gripper, speed, _Curve(position, rotation, radius * end))


def _solve_curve(
    kinematics: PivotKinematics, start: np.ndarray, gripper: float, speed: float, curve: _Curve
) -> JointPath | None:
    keys = curve.rotation(curve.rotation.times)
    angle = float((keys[:-1].inv() * keys[1:]).magnitude().sum())
    steps = int(np.clip(np.ceil(max(curve.length_m / _STEP_M, angle / _STEP_RAD)), 2, _MAX_STEPS))
    points = np.empty((steps + 1, z1.N_JOINTS))
    points[0] = start
    points[:, z1.N_ARM] = np.linspace(start[z1.N_ARM], gripper, steps + 1)
    for i in range(1, steps + 1):
        T = make_pose(curve.rotation(i / steps).as_matrix(), curve.position(i / steps))
        # From the solution before, which keeps the arm in one branch
        q = kinematics.inverse(T, points[i - 1, : z1.N_ARM], _MAX_CHANGE_RAD)
        if q is None:
            return None
        points[i, : z1.N_ARM] = q
    pivot_s = _PEAK_SPEED * max(curve.length_m / speed, angle / _TURN_SPEED)
    return JointPath(points, max(pivot_s, _duration(points, float(z1.DQ_MAX[0]))))


def _duration(points: np.ndarray, max_speed: float) -> float:
    """Return the minimum duration [s] of a path through `points` (N, 7) at up to `max_speed` [rad/s]."""
    steepest = np.abs(np.diff(points, axis=0)).max(axis=0) * (len(points) - 1)
    by_speed = _PEAK_SPEED * steepest / np.minimum(max_speed, z1.DQ_MAX)
    by_acceleration = np.sqrt(_PEAK_ACCELERATION * steepest / z1.DDQ_MAX)
    return float(max(by_speed.max(), by_acceleration.max(), MIN_DURATION_S))
