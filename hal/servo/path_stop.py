"""Stops on a planned path: its time slows down to zero, so that the arm never leaves what was checked."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from hal.base.z1 import CONTROL_PERIOD_S
from hal.servo.limits import ServoLimits

_MIN_STOP_S = 10 * CONTROL_PERIOD_S  # a stop from almost no speed still gets a few ticks to slow down in


class StoppablePath(Protocol):
    """A buffered trajectory (`hal.servo.trajectory_buffer.TrajectoryBuffer`)."""

    def at(self, t_s: float) -> tuple[np.ndarray, np.ndarray]: ...

    def stop_duration(self, t_s: float) -> float: ...


class PathStop:
    """A stop along the trajectory being played, at the rate 1 − 3u² + 2u³ of its time with u = t / `duration_s`."""

    def __init__(self, path: StoppablePath, start_s: float) -> None:
        self._path, self._start_s = path, start_s
        self.duration_s = path.stop_duration(start_s)
        """Duration until rest [s]; the trajectory's own time advances by half of that."""

    def at(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity (7,) `t_s` [s] after the stop began."""
        # The time's rate starts at 1 and ends at 0, each with zero slope.
        u = min(t_s / self.duration_s, 1.0)
        q, dq = self._path.at(self._start_s + self.duration_s * (u - u**3 + 0.5 * u**4))
        return q, (1.0 - 3.0 * u**2 + 2.0 * u**3) * dq

    @property
    def q_rest(self) -> np.ndarray:
        """(7,) position at rest [rad]."""
        return self.at(self.duration_s)[0]


def path_stop_durations(dq: np.ndarray, limits: ServoLimits) -> np.ndarray:
    """Return the durations (N,) [s] of stops that begin at each of the points, a control period apart.

    Each is as long as the motion's acceleration and jerk need for the speed there, at most `brake_s`.

    Args:
        dq: (N, 7) velocities of the points [rad/s].
        limits: of the servo.
    """
    # A stop of `brake_s` covers half of that in the path's own time.
    speed = _sliding_max(np.abs(dq), round(0.5 * limits.brake_s / CONTROL_PERIOD_S) + 1)
    # Maxima of the slow-down 1 − 3u² + 2u³ over the duration T: acceleration 3/2 v/T, jerk 6 v/T².
    needed_s = np.maximum(1.5 * speed / limits.ddq_max, np.sqrt(6.0 * speed / limits.dddq_max)).max(axis=1)
    return np.clip(needed_s, _MIN_STOP_S, limits.brake_s)


def _sliding_max(values: np.ndarray, width: int) -> np.ndarray:
    """Return the maximum of each row (N, 7) and the `width` − 1 after it."""
    out, done = values.copy(), 1
    while done < min(width, len(out)):
        shift = min(done, width - done)
        out[:-shift] = np.maximum(out[:-shift], out[shift:])
        done += shift
    return out
