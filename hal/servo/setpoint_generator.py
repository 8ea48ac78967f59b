"""The setpoint the servo wishes for each tick: playing, chasing, braking or holding, one joined to the next."""

from __future__ import annotations

import numpy as np

from hal.base.messages import ServoMode
from hal.base.z1 import CONTROL_PERIOD_S, N_ARM, N_JOINTS
from hal.servo.braking import Blend, Brake, TargetTracker, PathStop, StopPath, plan_path_stop
from hal.servo.limits import ServoLimits
from hal.servo.trajectory_buffer import TrajectoryBuffer

_AT_REST_RAD_S = 0.02
_YIELD_THRESHOLD_RAD = 0.01
_ON_PATH_RAD = 1e-6
_ZERO = np.zeros(N_JOINTS)
_ZERO.setflags(write=False)

JointCommand = tuple[np.ndarray, np.ndarray]
"""Positions (7,) [rad] and velocities (7,) [rad/s], before the limits."""


class SetpointGenerator:
    """What the commanded joints do; used by the tick's thread alone. Every call that returns a wish is one tick.

    Args:
        limits: for braking and blending.
        q: (7,) where it holds at first [rad].
    """

    def __init__(self, limits: ServoLimits, q: np.ndarray) -> None:
        self._limits = limits
        self._brake = Brake(limits)
        self._tracker = TargetTracker(limits)
        self.mode = ServoMode.HOLDING
        """HOLDING, TRACKING or BRAKING."""
        self.reason = ""
        """Why it brakes or dropped the last trajectory."""
        self.trajectory_id = 0
        """The last trajectory taken."""
        self.trajectory_time_s = 0.0
        """How far it has been played [s]."""
        self.finished = False
        """Whether it was played to its end."""
        self.q = self._hold_q = q
        """(7,) last position commanded [rad]; the arm after its limits, the gripper before its squeeze limit."""
        self._dq = self._ddq = _ZERO
        # A difference of speeds lags by half a tick, which is enough to make a chase swing about its target.
        self._tracked_ddq: np.ndarray | None = None
        self._stop_path: StopPath | PathStop | None = None
        self._blend: Blend | None = None
        self._since_s = 0.0  # ticks since the stop path or the blend began

    def update_last_command(self, q: np.ndarray, dq: np.ndarray) -> None:
        """The wish of this tick became position `q` (7,) [rad]; it was to move at `dq` (7,) [rad/s]."""
        self._ddq = (dq - self._dq) / CONTROL_PERIOD_S if self._tracked_ddq is None else self._tracked_ddq
        self._tracked_ddq = None
        self.q, self._dq = q, dq

    def begin(self, new: TrajectoryBuffer) -> None:
        """Change over to a new trajectory, wherever the arm is and however it moves."""
        self.trajectory_id, self.trajectory_time_s = new.trajectory_id, -CONTROL_PERIOD_S
        self.mode, self.reason, self.finished = ServoMode.TRACKING, "", False
        self._start_blend(*new.at(0.0))

    def skip(self, trajectory_id: int, reason: str) -> None:
        """Count a trajectory as taken and dropped: it was cancelled before its first tick."""
        self.trajectory_id, self.trajectory_time_s, self.finished, self.reason = trajectory_id, 0.0, False, reason

    def has_underrun(self, current: TrajectoryBuffer) -> bool:
        """Whether the buffer of a trajectory that is not complete ends before this tick."""
        return not current.final and self.trajectory_time_s + CONTROL_PERIOD_S > current.end_s + 1e-9

    def play(self, current: TrajectoryBuffer) -> JointCommand:
        """Move on by exactly one control period; at the end of a complete trajectory set `finished`."""
        # The end may come before a blend into the trajectory is over.
        self.trajectory_time_s = min(self.trajectory_time_s + CONTROL_PERIOD_S, current.end_s)
        q, dq = self._apply_blend(*current.at(self.trajectory_time_s))
        if current.final and self.trajectory_time_s >= current.end_s - 1e-9 and self._blend is None:
            self.finished = True
            if np.abs(dq).max() > _AT_REST_RAD_S:
                self.brake(f"trajectory {current.trajectory_id} ended in motion")
                return self.rest()
            self.mode, self._hold_q = ServoMode.HOLDING, q
            return q, _ZERO
        return q, dq

    def track(self, q: np.ndarray) -> JointCommand:
        """Move towards `q` (7,) [rad] within the limits of speed, acceleration and jerk."""
        self.mode, self.reason, self._blend, self._stop_path = ServoMode.TRACKING, "", None, None
        q, dq, self._tracked_ddq = self._tracker.step(q, self.q, self._dq, self._ddq)
        return q, dq

    def predict_rest_position(self) -> np.ndarray:
        """Return where (7,) the joints would come to rest if they braked from the present command [rad]."""
        path = self._brake.plan(self.q, self._dq, self._ddq)
        return path.at(path.duration_s)[0]

    def brake(self, reason: str, along: TrajectoryBuffer | None = None) -> None:
        """Begin to stop from the present command: on the path `along`, if that is what is being played and enough of it
        is left, else every joint by itself."""
        stop = None
        if along is not None and self._is_on(along):
            stop = plan_path_stop(along, self.trajectory_time_s, self._limits)
        self.mode, self.reason, self._blend, self._tracked_ddq = ServoMode.BRAKING, reason, None, None
        self._stop_path, self._since_s = stop or self._brake.plan(self.q, self._dq, self._ddq), 0.0

    def _is_on(self, path: TrajectoryBuffer) -> bool:
        """Whether the last command was a point of `path`: nothing blended into it, nothing clipped off it."""
        if path.trajectory_id != self.trajectory_id or self.mode is not ServoMode.TRACKING or self._blend is not None:
            return False
        return bool(np.abs(path.at(self.trajectory_time_s)[0] - self.q).max() < _ON_PATH_RAD)

    def rest(self) -> JointCommand:
        """Brake if that is not over, else hold."""
        if self._stop_path is None:
            return self._apply_blend(self._hold_q, _ZERO)
        self._since_s += CONTROL_PERIOD_S
        q, dq = self._stop_path.at(self._since_s)
        if self._since_s >= self._stop_path.duration_s:
            self._stop_path, self.mode, self._hold_q = None, ServoMode.HOLDING, q
        return q, dq

    def yield_to_measured(self, q_measured: np.ndarray) -> None:
        """Hold the arm where it is measured (7,) [rad], not where it was sent; the gripper keeps what it holds."""
        hold_q = self._hold_q.copy()
        off = np.abs(hold_q - q_measured) > _YIELD_THRESHOLD_RAD
        off[N_ARM] = False
        if off.any():
            hold_q[off] = q_measured[off]
            self._hold_q = hold_q
            self._start_blend(hold_q, _ZERO)

    def _start_blend(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Blend from the present command into a motion that begins with `q`, `dq`."""
        # The new motion begins a tick after the last command, and by then the old one would have gone on.
        gap, gap_rate = self.q + CONTROL_PERIOD_S * self._dq - q, self._dq - dq
        self._stop_path, self._blend, self._since_s = None, None, 0.0
        if np.abs(gap).max() > 1e-9 or np.abs(gap_rate).max() > 1e-9:
            self._blend = Blend(gap, gap_rate, self._limits.ddq_max)

    def _apply_blend(self, q: np.ndarray, dq: np.ndarray) -> JointCommand:
        if self._blend is None:
            return q, dq
        left, left_rate = self._blend.at(self._since_s)
        if self._since_s >= self._blend.duration_s:
            self._blend = None
        self._since_s += CONTROL_PERIOD_S
        return q + left, dq + left_rate
