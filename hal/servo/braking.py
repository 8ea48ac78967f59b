"""Braking: stops on the planned path, and where there is none, stops of every joint by itself.

A stop on the path slows its time down to zero, so that the arm never leaves what was checked. Stops of the joints,
tracking of a single target, and motions between two postures at rest are off any planned path: the servo commands a
step of them only while the stop from it, computed here, ends inside the joint limits and the guard's space
(`hal.servo.setpoint_generator`).
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from ruckig import InputParameter, Ruckig, Synchronization, Trajectory

from hal.base.z1 import CONTROL_PERIOD_S, N_JOINTS
from hal.servo.limits import ServoLimits

_SAMPLE_S = 0.005
"""Time between two postures of a stop that are checked [s]: at full speed a joint turns 0.016 rad in it."""
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


class MotionState(NamedTuple):
    """A point of a motion."""

    q: np.ndarray
    """(7,) positions [rad]."""
    dq: np.ndarray
    """(7,) velocities [rad/s]."""
    ddq: np.ndarray
    """(7,) accelerations [rad/s²]."""


class JointStop:
    """The fastest stop of every joint by itself within limits of acceleration and jerk.

    Each joint has three phases: jerk towards the deceleration, constant deceleration, and jerk back to 0.

    Args:
        state: present command.
        ddq_max: (7,) maximum accelerations [rad/s²]; more where `state` has more.
        dddq_max: (7,) maximum jerks [rad/s³].
    """

    def __init__(self, state: MotionState, ddq_max: np.ndarray, dddq_max: np.ndarray) -> None:
        # The direction in which a joint would move once its acceleration had been brought to 0.
        sign = np.where(state.dq + state.ddq * np.abs(state.ddq) / (2 * dddq_max) < 0.0, -1.0, 1.0)
        v, a, jerk = sign * state.dq, sign * state.ddq, dddq_max
        limit = np.maximum(ddq_max, np.abs(a))
        # The speed that is left for the deceleration's way down to its peak and back.
        peak_squared = np.maximum(jerk * v + 0.5 * a * a, 0.0)
        peak = np.minimum(np.sqrt(peak_squared), limit)
        held_s = (peak_squared - peak * peak) / np.maximum(jerk * peak, 1e-12)
        self._ends = np.cumsum([np.maximum(a + peak, 0.0) / jerk, held_s, peak / jerk], axis=0)  # (3, 7)
        # Position, velocity and acceleration at the beginning of each phase, and its jerk, all (7,).
        self._begin: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
        q, dq, ddq, begin = state.q, state.dq, state.ddq, np.zeros(N_JOINTS)
        for end, j in zip(self._ends, (-sign * jerk, np.zeros(N_JOINTS), sign * jerk), strict=True):
            self._begin.append((q, dq, ddq, j))
            t, begin = end - begin, end
            q, dq, ddq = q + t * (dq + t * (ddq / 2 + t * j / 6)), dq + t * (ddq + t * j / 2), ddq + t * j
        self.q_rest = q
        """(7,) position at rest [rad]."""
        self.duration_s = float(self._ends[-1].max())
        """Duration until the last joint is at rest [s]."""

    def at(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity (7,) `t_s` [s] after the stop began."""
        if t_s >= self.duration_s:
            return self.q_rest, np.zeros(N_JOINTS)
        q, dq = self._sample(np.array([[t_s]]))
        return q[0], dq[0]

    def positions(self) -> np.ndarray:
        """Return positions (N, 7) [rad] close to each other from the beginning to rest."""
        times = np.arange(0.0, self.duration_s, _SAMPLE_S)[:, None]
        return np.vstack([self._sample(times)[0], self.q_rest]) if len(times) else self.q_rest[None]

    def _sample(self, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities (N, 7) at `t_s` (N, 1) [s]."""
        first, second, last = self._ends
        phase = (t_s >= first).astype(np.intp) + (t_s >= second)
        joints = np.arange(N_JOINTS)
        q, dq, ddq, j = (np.array(values)[phase, joints] for values in zip(*self._begin, strict=True))
        t = np.minimum(t_s, last) - np.array([np.zeros(N_JOINTS), first, second])[phase, joints]
        moving = t_s < last
        q = q + t * (dq + t * (ddq / 2 + t * j / 6))
        return np.where(moving, q, self.q_rest), np.where(moving, dq + t * (ddq + t * j / 2), 0.0)


class TargetTracker:
    """An online trajectory generator to a target that may change every tick (Ruckig's position interface)."""

    def __init__(self, limits: ServoLimits) -> None:
        self._limits = limits
        self._ruckig = Ruckig(N_JOINTS)
        self._input = _make_input(limits)
        self._path = Trajectory(N_JOINTS)

    def step(self, q_target: np.ndarray, state: MotionState) -> MotionState:
        """Return the state one control period after `state`, on the fastest motion to rest at the target.

        A target beyond the joint limits is clipped to them.
        """
        limits, inp = self._limits, self._input
        inp.current_position = state.q.tolist()
        inp.current_velocity = np.clip(state.dq, -limits.dq_max, limits.dq_max).tolist()
        inp.current_acceleration = np.clip(state.ddq, -limits.ddq_max, limits.ddq_max).tolist()
        inp.target_position = np.clip(q_target, limits.q_min, limits.q_max).tolist()
        self._ruckig.calculate(inp, self._path)
        return MotionState(*map(np.array, self._path.at_time(CONTROL_PERIOD_S)))


class JointMove:
    """The fastest motion from rest to rest, each joint by itself."""

    def __init__(self, q_start: np.ndarray, q_goal: np.ndarray, limits: ServoLimits) -> None:
        inp = _make_input(limits)
        inp.current_position, inp.target_position = q_start.tolist(), q_goal.tolist()
        self._path = Trajectory(N_JOINTS)
        Ruckig(N_JOINTS).calculate(inp, self._path)
        self._q_goal = q_goal
        self.duration_s: float = self._path.duration
        """Duration [s]."""

    def at(self, t_s: float) -> MotionState:
        """Return the state `t_s` [s] after the start."""
        if t_s >= self.duration_s:
            return MotionState(self._q_goal, np.zeros(N_JOINTS), np.zeros(N_JOINTS))
        return MotionState(*map(np.array, self._path.at_time(t_s)))


def _make_input(limits: ServoLimits) -> InputParameter:
    inp = InputParameter(N_JOINTS)
    inp.synchronization = Synchronization.No
    inp.max_velocity = limits.dq_max.tolist()
    inp.max_acceleration = limits.ddq_max.tolist()
    inp.max_jerk = limits.dddq_max.tolist()
    return inp
