"""Setpoint generator: the joint command of each tick, from playing, tracking, braking or holding.

Every change from one of these to another starts at the last command, so the command never jumps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.base.messages import ServoMode
from hal.base.z1 import CONTROL_PERIOD_S, N_ARM, N_JOINTS
from hal.servo.braking import Blend, Brake, JointStop, PathStop, TargetTracker, plan_path_stop
from hal.servo.limits import ServoLimits
from hal.servo.trajectory_buffer import TrajectoryBuffer

_AT_REST_RAD_S = 0.02  # a trajectory whose last point is faster ends in motion and is braked
_YIELD_THRESHOLD_RAD = 0.01  # below it the difference to the measurement is the servo's ordinary tracking error
_ON_PATH_RAD = 1e-6  # rounding; a command that was clipped or blended is further off
_ZERO = np.zeros(N_JOINTS)
_ZERO.setflags(write=False)  # shared by all commands at rest


class JointCommand(NamedTuple):
    """A desired setpoint of one tick, before the limits."""

    q: np.ndarray
    """(7,) positions [rad]."""
    dq: np.ndarray
    """(7,) velocities [rad/s]."""


class SetpointGenerator:
    """The state of the commanded motion; used by the tick's thread alone.

    `begin`, `skip` and `brake` change the state. `play`, `track` and `brake_or_hold` return the command of one tick;
    `update_last_command` then records it as the limits have changed it.

    Args:
        limits: for braking and blending.
        q: (7,) initial position to hold [rad].
    """

    def __init__(self, limits: ServoLimits, q: np.ndarray) -> None:
        self._limits = limits
        self._brake = Brake(limits)
        self._tracker = TargetTracker(limits)
        self.mode = ServoMode.HOLDING
        """HOLDING, TRACKING or BRAKING."""
        self.reason = ""
        """Reason for braking or for dropping the last trajectory; empty when there is none."""
        self.trajectory_id = 0
        """Last trajectory begun or skipped."""
        self.trajectory_time_s = 0.0
        """Time reached on that trajectory [s]."""
        self.finished = False
        """True when that trajectory was played to its end."""
        self.q = self._hold_q = q
        """(7,) last commanded position [rad]: the arm's after its limits, the gripper's before its squeeze limit."""
        self._dq = self._ddq = _ZERO
        # The tracker's own acceleration: a difference of speeds lags by half a tick, enough to oscillate at the target.
        self._tracked_ddq: np.ndarray | None = None
        self._stop: JointStop | PathStop | None = None
        self._blend: Blend | None = None
        self._since_s = 0.0  # since the stop or the blend began

    def update_last_command(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Record the command after the limits: position `q` (7,) [rad] and velocity `dq` (7,) [rad/s]."""
        self._ddq = (dq - self._dq) / CONTROL_PERIOD_S if self._tracked_ddq is None else self._tracked_ddq
        self._tracked_ddq = None
        self.q, self._dq = q, dq

    def begin(self, new: TrajectoryBuffer) -> None:
        """Change over to a new trajectory from any state, by a blend."""
        self.trajectory_id, self.trajectory_time_s = new.trajectory_id, -CONTROL_PERIOD_S  # `play` advances first: to 0
        self.mode, self.reason, self.finished = ServoMode.TRACKING, "", False
        self._start_blend(*new.at(0.0))

    def skip(self, trajectory_id: int, reason: str) -> None:
        """Count a trajectory as begun and dropped: it was cancelled before its first tick."""
        self.trajectory_id, self.trajectory_time_s, self.finished, self.reason = trajectory_id, 0.0, False, reason

    def has_underrun(self, active: TrajectoryBuffer) -> bool:
        """Return True when the buffer of an incomplete trajectory ends before this tick."""
        # The tolerance covers the rounding of a sum of thousands of periods.
        return not active.final and self.trajectory_time_s + CONTROL_PERIOD_S > active.end_s + 1e-9

    def play(self, active: TrajectoryBuffer) -> JointCommand:
        """Advance by exactly one control period; at the end of a complete trajectory set `finished`."""
        # The end may come before a blend into the trajectory is over.
        self.trajectory_time_s = min(self.trajectory_time_s + CONTROL_PERIOD_S, active.end_s)
        q, dq = self._apply_blend(*active.at(self.trajectory_time_s))
        if active.final and self.trajectory_time_s >= active.end_s - 1e-9 and self._blend is None:
            self.finished = True
            if np.abs(dq).max() > _AT_REST_RAD_S:
                self.brake(f"trajectory {active.trajectory_id} ended in motion")
                return self.brake_or_hold()
            self.mode, self._hold_q = ServoMode.HOLDING, q
            return JointCommand(q, _ZERO)
        return JointCommand(q, dq)

    def track(self, q_target: np.ndarray) -> JointCommand:
        """Move towards `q_target` (7,) [rad] within the limits of speed, acceleration and jerk."""
        self.mode, self.reason, self._blend, self._stop = ServoMode.TRACKING, "", None, None
        q, dq, self._tracked_ddq = self._tracker.step(q_target, self.q, self._dq, self._ddq)
        return JointCommand(q, dq)

    def predict_rest_position(self) -> np.ndarray:
        """Return the position (7,) [rad] of the joints after braking from the present command."""
        stop = self._brake.plan(self.q, self._dq, self._ddq)
        return stop.at(stop.duration_s)[0]

    def brake(self, reason: str, along: TrajectoryBuffer | None = None) -> None:
        """Begin to stop from the present command: on the path `along` where it is being played and enough of it is
        buffered, else every joint by itself."""
        stop = None
        if along is not None and self._is_on(along):
            stop = plan_path_stop(along, self.trajectory_time_s, self._limits)
        self.mode, self.reason, self._blend, self._tracked_ddq = ServoMode.BRAKING, reason, None, None
        self._stop, self._since_s = stop or self._brake.plan(self.q, self._dq, self._ddq), 0.0

    def _is_on(self, path: TrajectoryBuffer) -> bool:
        """Return True when the last command was a point of `path`, neither blended into it nor clipped off it."""
        if path.trajectory_id != self.trajectory_id or self.mode is not ServoMode.TRACKING or self._blend is not None:
            return False
        return bool(np.abs(path.at(self.trajectory_time_s)[0] - self.q).max() < _ON_PATH_RAD)

    def brake_or_hold(self) -> JointCommand:
        """Continue a stop that is not over, else hold."""
        if self._stop is None:
            return self._apply_blend(self._hold_q, _ZERO)
        self._since_s += CONTROL_PERIOD_S
        q, dq = self._stop.at(self._since_s)
        if self._since_s >= self._stop.duration_s:
            self._stop, self.mode, self._hold_q = None, ServoMode.HOLDING, q
        return JointCommand(q, dq)

    def yield_to_measured(self, q_measured: np.ndarray) -> None:
        """Hold the measured arm position (7,) [rad] instead of the commanded one; the gripper keeps its command, so
        that it keeps its object."""
        hold_q = self._hold_q.copy()
        off = np.abs(hold_q - q_measured) > _YIELD_THRESHOLD_RAD
        off[N_ARM] = False
        if off.any():
            hold_q[off] = q_measured[off]
            self._hold_q = hold_q
            self._start_blend(hold_q, _ZERO)

    def _start_blend(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Blend from the present command into a motion that begins with `q`, `dq` (7,)."""
        # The new motion begins a tick after the last command, in which the old one would have continued.
        gap, gap_rate = self.q + CONTROL_PERIOD_S * self._dq - q, self._dq - dq
        self._stop, self._blend, self._since_s = None, None, 0.0
        if np.abs(gap).max() > 1e-9 or np.abs(gap_rate).max() > 1e-9:
            self._blend = Blend(gap, gap_rate, self._limits.ddq_max)

    def _apply_blend(self, q: np.ndarray, dq: np.ndarray) -> JointCommand:
        if self._blend is None:
            return JointCommand(q, dq)
        offset, offset_rate = self._blend.at(self._since_s)
        if self._since_s >= self._blend.duration_s:
            self._blend = None
        self._since_s += CONTROL_PERIOD_S
        return JointCommand(q + offset, dq + offset_rate)
