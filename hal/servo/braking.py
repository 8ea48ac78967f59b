"""Braking to rest, tracking of a single target, and blends between motions, all without a jump in the command.

A stop prefers the path that is being played (`PathStop`: same path, time slowed down). Where too little of it is
buffered, or the command is off the path, every joint brakes by itself (`Brake`, jerk-limited by Ruckig).
"""

from __future__ import annotations

import numpy as np
from ruckig import ControlInterface, InputParameter, Ruckig, Synchronization, Trajectory

from hal.base.z1 import CONTROL_PERIOD_S, N_JOINTS
from hal.servo.limits import ServoLimits
from hal.servo.trajectory_buffer import TrajectoryBuffer

_STEP_FACTOR = 1.25
_MAX_ATTEMPTS = 10  # 1.25⁹ = 7.5 times the limits at the last one
_MIN_STOP_S = 10 * CONTROL_PERIOD_S  # a stop from almost no speed still gets a few ticks to slow down in


class Brake:
    """A planner of jerk-limited stops by Ruckig's velocity interface."""

    def __init__(self, limits: ServoLimits) -> None:
        self._limits = limits
        self._ruckig = Ruckig(N_JOINTS)
        self._input = InputParameter(N_JOINTS)
        self._input.control_interface = ControlInterface.Velocity
        # Every joint stops as soon as it can; none is stretched to the slowest one's time.
        self._input.synchronization = Synchronization.No
        self._input.target_velocity = [0.0] * N_JOINTS
        self._input.target_acceleration = [0.0] * N_JOINTS

    def plan(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> JointStop:
        """Return the stop from `q`, `dq`, `ddq` (7,) [rad, rad/s, rad/s²].

        Acceleration and jerk are the limits' for every joint that comes to rest in time and inside its position
        limits with them (Ruckig ignores `max_position`, so the extrema are checked here); a joint that does not
        brakes harder, in steps of 25 %, up to 7.5 times as hard.
        """
        limits, inp = self._limits, self._input
        inp.current_position = q.tolist()
        inp.current_velocity = dq.tolist()
        inp.current_acceleration = np.clip(ddq, -limits.ddq_max, limits.ddq_max).tolist()
        # An arm that starts outside its limits may stay outside, but not go further.
        low, high = np.minimum(limits.q_min, q) - 1e-9, np.maximum(limits.q_max, q) + 1e-9
        factor = np.ones(N_JOINTS)
        path = Trajectory(N_JOINTS)
        for _ in range(_MAX_ATTEMPTS):
            inp.max_acceleration = (factor * limits.ddq_max).tolist()
            inp.max_jerk = (factor * limits.dddq_max).tolist()
            self._ruckig.calculate(inp, path)
            extrema = path.position_extrema
            # Each joint's own; `path.duration` is the slowest one's.
            late = np.array(path.independent_min_durations) > limits.brake_s
            outside = np.array([e.min for e in extrema]) < low
            outside |= np.array([e.max for e in extrema]) > high
            if not (late | outside).any():
                break
            factor[late | outside] *= _STEP_FACTOR
        return JointStop(path)


class JointStop:
    """A stop of every joint by itself, which leaves the path."""

    def __init__(self, path: Trajectory) -> None:
        self._path = path
        self.duration_s: float = path.duration
        """Duration until the last joint is at rest [s]."""

    def at(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity (7,) `t_s` [s] after the stop began."""
        q, dq, _ = self._path.at_time(min(t_s, self.duration_s))
        return np.array(q), np.array(dq)


class PathStop:
    """A stop along the trajectory being played: its time slows down to zero, and the arm stays on the planned path."""

    def __init__(self, path: TrajectoryBuffer, start_s: float, duration_s: float) -> None:
        self._path, self._start_s = path, start_s
        self.duration_s = duration_s
        """Duration until rest [s]; the trajectory's own time advances by half of that."""

    def at(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity (7,) `t_s` [s] after the stop began."""
        # The time's rate is 1 − 3u² + 2u³: it starts at 1 and ends at 0, each with zero slope.
        u = min(t_s / self.duration_s, 1.0)
        q, dq = self._path.at(self._start_s + self.duration_s * (u - u**3 + 0.5 * u**4))
        return q, (1.0 - 3.0 * u**2 + 2.0 * u**3) * dq


def plan_path_stop(path: TrajectoryBuffer, start_s: float, limits: ServoLimits) -> PathStop | None:
    """Return the stop along `path` from its time `start_s` [s]; None where too little of it is buffered to stop on.

    It lasts as long as the limits of acceleration and jerk need for the speed there, at most `brake_s`.
    """
    # A stop of `brake_s` covers half of that in the path's own time, so the last sample is there.
    speed = np.abs([path.at(start_s + ratio * limits.brake_s)[1] for ratio in (0.0, 0.25, 0.5)]).max(axis=0)
    # Maxima of the slow-down 1 − 3u² + 2u³ over the duration T: acceleration 3/2 v/T, jerk 6 v/T².
    needed_s = np.max([1.5 * speed / limits.ddq_max, np.sqrt(6.0 * speed / limits.dddq_max)])
    duration_s = min(max(float(needed_s), _MIN_STOP_S), limits.brake_s)
    return PathStop(path, start_s, duration_s) if start_s + 0.5 * duration_s <= path.end_s else None


class TargetTracker:
    """An online trajectory generator to a target that may change every tick (Ruckig's position interface)."""

    def __init__(self, limits: ServoLimits) -> None:
        self._limits = limits
        self._ruckig = Ruckig(N_JOINTS)
        self._input = InputParameter(N_JOINTS)
        self._input.synchronization = Synchronization.No
        self._input.max_velocity = limits.dq_max.tolist()
        self._input.max_acceleration = limits.ddq_max.tolist()
        self._input.max_jerk = limits.dddq_max.tolist()
        self._path = Trajectory(N_JOINTS)

    def step(
        self, q_target: np.ndarray, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return position, velocity and acceleration (7,) one control period after `q`, `dq`, `ddq` (7,).

        They are on the fastest motion to rest at the target; a target beyond the joint limits is clipped to them.
        """
        limits, inp = self._limits, self._input
        inp.current_position = q.tolist()
        inp.current_velocity = np.clip(dq, -limits.dq_max, limits.dq_max).tolist()
        inp.current_acceleration = np.clip(ddq, -limits.ddq_max, limits.ddq_max).tolist()
        inp.target_position = np.clip(q_target, limits.q_min, limits.q_max).tolist()
        self._ruckig.calculate(inp, self._path)
        q_next, dq_next, ddq_next = self._path.at_time(CONTROL_PERIOD_S)
        return np.array(q_next), np.array(dq_next), np.array(ddq_next)


class Blend:
    """An offset in position and velocity that decays to zero as a cubic within the acceleration limits.

    Added to a motion, it makes that motion start from the present command.

    Args:
        q: (7,) initial position offset [rad].
        dq: (7,) initial velocity offset [rad/s].
        ddq_max: (7,) maximum accelerations [rad/s²].
    """

    def __init__(self, q: np.ndarray, dq: np.ndarray, ddq_max: np.ndarray) -> None:
        # The cubic from (q, dq) to rest in T has its maximum acceleration at an end: at most 6|q|/T² + 4|dq|/T.
        v, a = np.abs(dq), ddq_max
        self.duration_s = float(((4 * v + np.sqrt(16 * v * v + 24 * a * np.abs(q))) / (2 * a)).max())
        self._q, self._dq = q, dq

    def at(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the offset left (7,) [rad] and its rate (7,) [rad/s] at `t_s` [s]."""
        T = self.duration_s
        if t_s >= T:
            return np.zeros_like(self._q), np.zeros_like(self._q)
        s = t_s / T
        q = (1 - s) ** 2 * ((1 + 2 * s) * self._q + s * T * self._dq)
        dq = 6 * s * (s - 1) / T * self._q + (3 * s * s - 4 * s + 1) * self._dq
        return q, dq
