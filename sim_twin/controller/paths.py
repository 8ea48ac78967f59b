"""The ways of the controller's own motions: through joint space, along a line, along an arc.

The vendor's profiles are not published. These start and end at rest with the least jerk, keep the speed that was asked
for, and stay within what the joints can do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from hal.base import z1
from hal.compat.unitree_arm_interface.model import Z1Model, postureToHomo

SHORTEST_S = 0.02
"""No motion is over sooner [s]: a client sees every state in some answer."""

# Of the least-jerk profile over a unit of way and time.
_PEAK_SPEED, _PEAK_ACCELERATION = 1.875, 5.7735
_STEP_M, _STEP_RAD, _MOST_STEPS = 0.01, 0.04, 200
_TURN_SPEED = 1.0  # [rad/s]
_STRAIGHT = 1e-6


class _Curve(NamedTuple):
    """Where the pivot goes, over 0 to 1."""

    place: Callable[[float], np.ndarray]
    turn: Slerp
    length_m: float


class Path:
    """Positions over time.

    Args:
        points: (N, 7) joint positions [rad], N ≥ 2, evenly spread over the way.
        duration_s: [s].
        even: at even speed, as it was recorded; else from rest to rest.
    """

    def __init__(self, points: np.ndarray, duration_s: float, *, even: bool = False) -> None:
        self.duration_s = duration_s
        self._even = even
        self._spline = CubicSpline(np.linspace(0.0, 1.0, len(points)), points)
        self._slope = self._spline.derivative()

    def at(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (7,) [rad] and speeds (7,) [rad/s] at `t_s` [s], the end's at and after the end."""
        u = min(t_s / self.duration_s, 1.0)
        if u >= 1.0:
            return self._spline(1.0), np.zeros(z1.N_JOINTS)
        if self._even:
            return self._spline(u), self._slope(u) / self.duration_s
        s, rate = u**3 * (10.0 - 15.0 * u + 6.0 * u**2), 30.0 * (u * (1.0 - u)) ** 2
        return self._spline(s), self._slope(s) * rate / self.duration_s


def joint_path(start: np.ndarray, goal: np.ndarray, max_speed: float) -> Path:
    """Return the way from `start` (7,) to `goal` (7,) [rad], no joint faster than `max_speed` [rad/s] (above 0)."""
    points = np.array([start, goal])
    return Path(points, _duration(points, max_speed))


def line_path(model: Z1Model, start: np.ndarray, posture: np.ndarray, gripper: float, speed: float) -> Path | None:
    """Return the way from `start` (7,) [rad] on which the pivot goes straight to `posture` (6,) at up to `speed`
    [m/s] (above 0), the gripper meanwhile to `gripper` [rad]; None when not all of it can be reached."""
    first, last = model.forwardKinematics(start[: z1.N_ARM]), postureToHomo(posture)
    turn = Slerp([0.0, 1.0], Rotation.from_matrix([first[:3, :3], last[:3, :3]]))
    way = last[:3, 3] - first[:3, 3]
    curve = _Curve(lambda u: first[:3, 3] + u * way, turn, float(np.linalg.norm(way)))
    return _along(model, start, gripper, speed, curve)


def arc_path(model: Z1Model, start: np.ndarray, postures: np.ndarray, gripper: float, speed: float) -> Path | None:
    """Return the same along the circle through the pivot's present place and `postures` (2, 6), ending in the second;
    None when not all of it can be reached, or when the three lie on a line."""
    poses = [model.forwardKinematics(start[: z1.N_ARM]), *(postureToHomo(posture) for posture in postures)]
    a, b, c = (pose[:3, 3] for pose in poses)
    normal = np.cross(b - a, c - a)
    size = float(np.linalg.norm(normal))
    if size < _STRAIGHT:
        return None
    ab, ac = b - a, c - a
    centre = a + (np.cross(normal, ab) * (ac @ ac) + np.cross(ac, normal) * (ab @ ab)) / (2.0 * size**2)
    radius = float(np.linalg.norm(a - centre))
    x_axis = (a - centre) / radius
    y_axis = np.cross(normal / size, x_axis)
    middle, end = (float(np.arctan2((p - centre) @ y_axis, (p - centre) @ x_axis)) % (2 * np.pi) for p in (b, c))
    turn = Slerp([0.0, middle / end, 1.0], Rotation.from_matrix([pose[:3, :3] for pose in poses]))

    def place(u: float) -> np.ndarray:
        return centre + radius * (np.cos(u * end) * x_axis + np.sin(u * end) * y_axis)

    return _along(model, start, gripper, speed, _Curve(place, turn, radius * end))


def _along(model: Z1Model, start: np.ndarray, gripper: float, speed: float, curve: _Curve) -> Path | None:
    keys = curve.turn(curve.turn.times)
    angle = float((keys[:-1].inv() * keys[1:]).magnitude().sum())
    steps = int(np.clip(np.ceil(max(curve.length_m / _STEP_M, angle / _STEP_RAD)), 2, _MOST_STEPS))
    points = np.empty((steps + 1, z1.N_JOINTS))
    points[0] = start
    points[:, z1.N_ARM] = np.linspace(start[z1.N_ARM], gripper, steps + 1)
    T = np.eye(4)
    for i in range(1, steps + 1):
        T[:3, :3], T[:3, 3] = curve.turn(i / steps).as_matrix(), curve.place(i / steps)
        found, points[i, : z1.N_ARM] = model.inverseKinematics(T, points[i - 1, : z1.N_ARM])
        if not found:
            return None
    pivot_s = _PEAK_SPEED * max(curve.length_m / speed, angle / _TURN_SPEED)
    return Path(points, max(pivot_s, _duration(points, float(z1.DQ_MAX[0]))))


def _duration(points: np.ndarray, max_speed: float) -> float:
    """Return the least time in which the joints can go through `points` (N, 7) at up to `max_speed` [rad/s]."""
    steepest = np.abs(np.diff(points, axis=0)).max(axis=0) * (len(points) - 1)
    by_speed = _PEAK_SPEED * steepest / np.minimum(max_speed, z1.DQ_MAX)
    by_acceleration = np.sqrt(_PEAK_ACCELERATION * steepest / z1.DDQ_MAX)
    return float(max(by_speed.max(), by_acceleration.max(), SHORTEST_S))
