"""How the servo comes to rest, and how it joins one motion to the next, without a jump."""

from __future__ import annotations

import numpy as np
from ruckig import ControlInterface, InputParameter, Ruckig, Synchronization, Trajectory

from hal.base.z1 import CONTROL_PERIOD_S, N_JOINTS
from hal.servo.limits import ServoLimits
from hal.servo.trajectory_buffer import TrajectoryBuffer

_HARDER = 1.25
_ATTEMPTS = 10
_SHORTEST_S = 10 * CONTROL_PERIOD_S


class Brake:
    """Plans jerk-limited stops with Ruckig's velocity interface."""

    def __init__(self, limits: ServoLimits) -> None:
        self._limits = limits
        self._ruckig = Ruckig(N_JOINTS)
        self._input = InputParameter(N_JOINTS)
        self._input.control_interface = ControlInterface.Velocity
        # Every joint stops as soon as it can; none is stretched to the slowest one's time.
        self._input.synchronization = Synchronization.No
        self._input.target_velocity = [0.0] * N_JOINTS
        self._input.target_acceleration = [0.0] * N_JOINTS

    def plan(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> StopPath:
        """Return the stop from `q`, `dq`, `ddq` (7,) [rad, rad/s, rad/s²].

        Acceleration and jerk are the limits' for every joint that comes to rest in time and inside its position
        limits with them (Ruckig ignores `max_position`, so the extrema are checked here); a joint that does not
        brakes harder, in steps of 25 %, up to nine times as hard.
        """
        limits, inp = self._limits, self._input
        inp.current_position = q.tolist()
        inp.current_velocity = dq.tolist()
        inp.current_acceleration = np.clip(ddq, -limits.ddq_max, limits.ddq_max).tolist()
        low, high = np.minimum(limits.q_min, q) - 1e-9, np.maximum(limits.q_max, q) + 1e-9
        harder = np.ones(N_JOINTS)
        path = Trajectory(N_JOINTS)
        for _ in range(_ATTEMPTS):
            inp.max_acceleration = (harder * limits.ddq_max).tolist()
            inp.max_jerk = (harder * limits.dddq_max).tolist()
            self._ruckig.calculate(inp, path)
            extrema = path.position_extrema
            late = np.array(path.independent_min_durations) > limits.brake_s
            outside = np.array([e.min for e in extrema]) < low
            outside |= np.array([e.max for e in extrema]) > high
            if not (late | outside).any():
                break
            harder[late | outside] *= _HARDER
        return StopPath(path)


class StopPath:
    """One planned stop."""

    def __init__(self, path: Trajectory) -> None:
        self._path = path
        self.duration_s: float = path.duration
        """How long it takes [s]."""

    def at(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity (7,) `t_s` [s] after the stop began."""
        q, dq, _ = self._path.at_time(min(t_s, self.duration_s))
        return np.array(q), np.array(dq)


class PathStop:
    """A stop on the path that is being played: its time runs ever slower, and the arm stays where it was to be."""

    def __init__(self, path: TrajectoryBuffer, start_s: float, duration_s: float) -> None:
        self._path, self._start_s = path, start_s
        self.duration_s = duration_s
        """How long it takes [s]; the path's own time goes on by half of that."""

    def at(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity (7,) `t_s` [s] after the stop began."""
        u = min(t_s / self.duration_s, 1.0)
        q, dq = self._path.at(self._start_s + self.duration_s * (u - u**3 + 0.5 * u**4))
        return q, (1.0 - 3.0 * u**2 + 2.0 * u**3) * dq


def plan_path_stop(path: TrajectoryBuffer, start_s: float, limits: ServoLimits) -> PathStop | None:
    """Return the stop on `path` from its time `start_s` [s]; None where too little of it is left to stop on.

    It takes as long as the limits of acceleration and jerk want for the speed there, but no longer than `brake_s`.
    """
    speed = np.abs([path.at(start_s + share * limits.brake_s)[1] for share in (0.0, 0.25, 0.5)]).max(axis=0)
    # What slowing down asks of a joint at most: 3/2 v/T and 6 v/T².
    wanted_s = np.max([1.5 * speed / limits.ddq_max, np.sqrt(6.0 * speed / limits.dddq_max)])
    duration_s = min(max(float(wanted_s), _SHORTEST_S), limits.brake_s)
    return PathStop(path, start_s, duration_s) if start_s + 0.5 * duration_s <= path.end_s else None


class TargetTracker:
    """Moves towards a target that may change every tick, with Ruckig's position interface."""

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

        They lie on the fastest way to rest at the target; one beyond the joint limits is taken as the limit.
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
    """A difference in position and velocity that dies out as a cubic within the acceleration limits.

    Added to a motion it makes that motion start where the arm is now.
    """

    def __init__(self, q: np.ndarray, dq: np.ndarray, ddq_max: np.ndarray) -> None:
        # The cubic from (q, dq) to rest in T has its largest acceleration at an end: at most 6|q|/T² + 4|dq|/T.
        v, a = np.abs(dq), ddq_max
        self.duration_s = float(((4 * v + np.sqrt(16 * v * v + 24 * a * np.abs(q))) / (2 * a)).max())
        self._q, self._dq = q, dq

    def at(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return what is left of the difference (7,) [rad] and its rate (7,) [rad/s] at `t_s` [s]."""
        T = self.duration_s
        if t_s >= T:
            return np.zeros_like(self._q), np.zeros_like(self._q)
        s = t_s / T
        q = (1 - s) ** 2 * ((1 + 2 * s) * self._q + s * T * self._dq)
        dq = 6 * s * (s - 1) / T * self._q + (3 * s * s - 4 * s + 1) * self._dq
        return q, dq
