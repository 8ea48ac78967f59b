"""Paths of the controller's own motions in joint space, timed by the vendor's jerk-limited profile (measured)."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline

from hal.base import z1

JOINT_JERK = 30.0
"""Jerk of the fastest joint [rad/s³] (measured on the vendor's controller)."""

_REST = np.zeros(z1.N_JOINTS)
_REST.setflags(write=False)


class Path(Protocol):
    """Joint positions over time."""

    duration_s: float
    """Duration [s]."""

    def sample(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (7,) [rad] and speeds (7,) [rad/s] at `t_s` [s], at rest at and after the end."""
        ...


class SCurve:
    """Profile from rest to rest with constant jerk and a limited speed; the acceleration has no limit of its own.

    Args:
        distance: distance, in any unit; 0 lasts no time.
        speed: maximum speed, above 0.
        jerk: jerk of its first, second, third and last quarter of speeding up and slowing down.
    """

    def __init__(self, distance: float, speed: float, jerk: float) -> None:
        # Speed rises over two ramps of `ramp` seconds; a short way ends before the maximum speed
        self._ramp_s = min(np.sqrt(speed / jerk), np.cbrt(distance / (2.0 * jerk)))
        self._jerk, self._distance = jerk, distance
        peak = jerk * self._ramp_s**2
        self.duration_s = distance / peak + 2.0 * self._ramp_s if peak > 0.0 else 0.0
        """Duration [s]."""

    def sample(self, t_s: float) -> tuple[float, float]:
        """Return the travelled ratio, 0 to 1, and its rate [1/s] at `t_s` [s]."""
        if t_s >= self.duration_s:
            return 1.0, 0.0
        from_end = t_s > self.duration_s / 2.0
        travelled, speed = self._rise(self.duration_s - t_s if from_end else t_s)
        return (self._distance - travelled if from_end else travelled) / self._distance, speed / self._distance

    def _rise(self, t_s: float) -> tuple[float, float]:
        """Return distance and speed `t_s` [s] after the start, or before the end."""
        ramp, jerk = self._ramp_s, self._jerk
        if t_s <= ramp:
            return jerk * t_s**3 / 6.0, jerk * t_s**2 / 2.0
        peak = jerk * ramp**2
        left = 2.0 * ramp - t_s
        if left > 0.0:
            return peak * (t_s - ramp) + jerk * left**3 / 6.0, peak - jerk * left**2 / 2.0
        return peak * (t_s - ramp), peak


class JointPath:
    """Straight path in joint space, in which the joint with the longest way keeps to the speed.

    Args:
        start: (7,) [rad].
        goal: (7,) [rad].
        max_speed: maximum speed [rad/s], above 0.
    """

    def __init__(self, start: np.ndarray, goal: np.ndarray, max_speed: float) -> None:
        self._start, self._step = start, goal - start
        self._profile = SCurve(float(np.abs(self._step).max()), max_speed, JOINT_JERK)
        self.duration_s = self._profile.duration_s

    def sample(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        s, rate = self._profile.sample(t_s)
        return self._start + s * self._step, rate * self._step


class Recording:
    """Motion taught by hand, at its own speed.

    Args:
        points: (N, 7) [rad], N ≥ 2.
        period_s: time between two points [s].
    """

    def __init__(self, points: np.ndarray, period_s: float) -> None:
        self.duration_s = (len(points) - 1) * period_s
        self._spline = CubicSpline(period_s * np.arange(len(points)), points)
        self._slope = self._spline.derivative()

    def sample(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        if t_s >= self.duration_s:
            return self._spline(self.duration_s), _REST
        return self._spline(t_s), self._slope(t_s)
