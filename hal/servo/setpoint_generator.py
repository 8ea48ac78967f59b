"""Setpoint generator: the joint command of each tick, from playing, tracking, braking or holding.

Every change from one of these to another starts at the last command with its speed and acceleration, so neither jumps.
At any tick a stop from the last command is known that stays inside the joint limits and the guard's space: on a
trajectory, whose points were checked, by slowing down its time, which needs no more of it than is buffered; off it, as
`_escape`, checked before the command was sent.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hal.base.messages import ServoMode
from hal.base.z1 import CONTROL_PERIOD_S, N_ARM, N_JOINTS
from hal.servo.braking import JointMove, JointStop, MotionState, PathStop, TargetTracker
from hal.servo.limits import ServoLimits
from hal.servo.trajectory_buffer import TrajectoryBuffer

_YIELD_THRESHOLD_RAD = 0.01  # below it the difference to the measurement is the servo's ordinary tracking error
_ON_PATH_RAD = 1e-6  # rounding; a command that was clipped is further off
_THERE_RAD = 1e-9  # rounding; a step of so much needs no motion
_START_TIMEOUT_TICKS = 250  # half a second for the second chunk of a trajectory
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
        limits: of motions and stops.
        q: (7,) initial position to hold [rad].
        find_violation: returns how the postures (N, 7) [rad] violate the guard; empty when they do not.
    """

    def __init__(
        self, limits: ServoLimits, q: np.ndarray, find_violation: Callable[[np.ndarray], str] = lambda _: ""
    ) -> None:
        self._limits = limits
        self._find_violation = find_violation
        self._tracker = TargetTracker(limits)
        self.mode = ServoMode.HOLDING
        """HOLDING, TRACKING or BRAKING."""
        self.reason = ""
        """Reason for braking or for dropping the last trajectory; empty when there is none."""
        self.trajectory_id = 0
        """Last trajectory begun or skipped."""
        self.trajectory_time_s = 0.0
        """Time reached on that trajectory [s]; negative before its first point."""
        self.finished = False
        """True when that trajectory was played to its end."""
        self.q = self._hold_q = q
        """(7,) last commanded position [rad]: the arm's after its limits, the gripper's before its squeeze limit."""
        self._dq = _ZERO
        self._path: TrajectoryBuffer | None = None  # the trajectory that is being played, as last buffered
        self._move: JointMove | None = None  # to a trajectory's first point, or to the measured arm
        self._state: MotionState | None = None  # of the last command off a trajectory
        self._escape: JointStop | None = None  # from that command
        self._stop: JointStop | PathStop | None = None
        self._since_s = 0.0  # since the stop or the move began
        self._waited_ticks = 0

    @property
    def is_moving(self) -> bool:
        """True until the arm is at rest."""
        return self.mode is not ServoMode.HOLDING or self._move is not None

    def update_last_command(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Record the command after the limits: position `q` (7,) [rad] and velocity `dq` (7,) [rad/s]."""
        self.q, self._dq = q, dq
        if self._state is not None:
            self._state = self._state._replace(q=q)

    # --- Trajectories -------------------------------------------------------------------------------------------

    def begin(self, new: TrajectoryBuffer, q_sent: np.ndarray) -> None:
        """Change over from rest to a new trajectory, by a motion to its first point where that is elsewhere.

        Args:
            new: the trajectory, which starts at rest.
            q_sent: (7,) last setpoint sent [rad]; a gripper that squeezes begins where it is, or at the angle that it
                was commanded to, whichever is nearer.
        """
        self.trajectory_id, self.trajectory_time_s = new.trajectory_id, -CONTROL_PERIOD_S  # `play` advances first: to 0
        self.mode, self.reason, self.finished = ServoMode.TRACKING, "", False
        self._path, self._stop, self._waited_ticks = new, None, 0
        first, here = new.q[0], self.q.copy()
        if abs(first[N_ARM] - q_sent[N_ARM]) < abs(first[N_ARM] - here[N_ARM]):
            here[N_ARM] = q_sent[N_ARM]
        self._hold_q = self.q = here
        self._start_move(first)

    def skip(self, trajectory_id: int, reason: str) -> None:
        """Count a trajectory as begun and dropped: it was cancelled before its first tick."""
        self.trajectory_id, self.trajectory_time_s, self.finished, self.reason = trajectory_id, 0.0, False, reason

    def has_underrun(self, active: TrajectoryBuffer) -> bool:
        """Return True when no stop from the next point would end on the buffered part of the trajectory."""
        next_s = self.trajectory_time_s + CONTROL_PERIOD_S
        if next_s > 0.0:
            return not active.can_stop_from(next_s)
        if self._move is None and not self._is_ready(active):
            self._waited_ticks += 1
        return self._waited_ticks > _START_TIMEOUT_TICKS

    def play(self, active: TrajectoryBuffer) -> JointCommand:
        """Advance by exactly one control period; at the end of a complete trajectory set `finished`."""
        if self._move is not None:
            return self._continue_move("to the trajectory's start")
        if self.trajectory_time_s < 0.0 and not self._is_ready(active):
            return JointCommand(self._hold_q, _ZERO)
        next_s = min(self.trajectory_time_s + CONTROL_PERIOD_S, active.end_s)
        q, dq = active.at(next_s)
        # The trajectory was checked when it was queued; this is the last net below that.
        if violation := self._find_violation(np.array([q, PathStop(active, next_s).q_rest])):
            self.brake(f"guard: trajectory {active.trajectory_id} {violation}")
            return self.brake_or_hold()
        self._path, self.trajectory_time_s = active, next_s
        if active.final and next_s >= active.end_s - 1e-9:
            self.finished, self.mode, self._hold_q = True, ServoMode.HOLDING, q
            return JointCommand(q, _ZERO)
        return JointCommand(q, dq)

    def _is_ready(self, active: TrajectoryBuffer) -> bool:
        """Return True when enough is buffered to stop on at any speed: a first chunk may be short."""
        return active.final or active.end_s >= 0.5 * self._limits.brake_s

    # --- Motions off a trajectory -------------------------------------------------------------------------------

    def track(self, q_target: np.ndarray) -> JointCommand:
        """Move towards `q_target` (7,) [rad] within the limits of speed, acceleration and jerk."""
        self.mode, self.reason, self._path = ServoMode.TRACKING, "", None
        return self._step_to(self._tracker.step(q_target, self._state or self._at_rest()), "to the setpoint")

    def yield_to_measured(self, q_measured: np.ndarray) -> None:
        """Hold the measured arm position (7,) [rad] instead of the commanded one; the gripper keeps its command, so
        that it keeps its object."""
        limits, here = self._limits, self._hold_q
        inside = np.clip(q_measured, np.minimum(limits.q_min, here), np.maximum(limits.q_max, here))
        off = np.abs(here - inside) > _YIELD_THRESHOLD_RAD
        off[N_ARM] = False
        if off.any():
            self._start_move(np.where(off, inside, here))

    def _start_move(self, q_goal: np.ndarray) -> None:
        if np.abs(q_goal - self.q).max() > _THERE_RAD:
            self._move, self._since_s = JointMove(self.q, q_goal, self._limits), 0.0

    def _continue_move(self, what: str) -> JointCommand:
        """Advance the motion to a trajectory's start."""
        assert self._move is not None
        self._since_s += CONTROL_PERIOD_S
        state = self._move.at(self._since_s)
        if self._since_s < self._move.duration_s:
            return self._step_to(state, what)
        self._hold_q = state.q
        self._clear_motion()
        return JointCommand(state.q, _ZERO)

    def _step_to(self, state: MotionState, what: str) -> JointCommand:
        """Return the command of `state` if the stop from it is allowed, else begin the one that is known to be."""
        stop = JointStop(state, self._limits.brake_ddq_max, self._limits.brake_dddq_max)
        if problem := self._find_problem(stop):
            self.brake(f"guard: the motion {what} {problem}")
            return self.brake_or_hold()
        self._state, self._escape = state, stop
        return JointCommand(state.q, state.dq)

    def _find_problem(self, stop: JointStop) -> str:
        """Return how `stop` leaves the joint limits or the guard's space; empty when it does not."""
        q = stop.positions()
        low, high = np.minimum(self._limits.q_min, self.q) - _THERE_RAD, np.maximum(self._limits.q_max, self.q)
        if ((q < low) | (q > high + _THERE_RAD)).any():
            return "could not be stopped inside the joint limits"
        return self._find_violation(q)

    def _at_rest(self) -> MotionState:
        return MotionState(self.q, _ZERO, _ZERO)

    # --- Stops --------------------------------------------------------------------------------------------------

    def brake(self, reason: str) -> None:
        """Begin to stop: on the trajectory that is being played, else every joint by itself; at rest, hold."""
        self._stop, self._since_s = self._plan_stop(), 0.0
        self.mode = ServoMode.HOLDING if self._stop is None else ServoMode.BRAKING
        self.reason, self._hold_q = reason, self.q
        self._clear_motion()

    def _plan_stop(self) -> JointStop | PathStop | None:
        if self._escape is not None and self._state is not None:
            gentle = JointStop(self._state, self._limits.ddq_max, self._limits.dddq_max)
            late = gentle.duration_s > self._limits.brake_s
            return self._escape if late or self._find_problem(gentle) else gentle
        if self.mode is not ServoMode.TRACKING or self._path is None or self.trajectory_time_s < 0.0:
            return None
        if np.abs(self._path.at(self.trajectory_time_s)[0] - self.q).max() < _ON_PATH_RAD:
            return PathStop(self._path, self.trajectory_time_s)
        # The arm's own limits have changed the command.
        state = MotionState(self.q, self._dq, _ZERO)
        return JointStop(state, self._limits.brake_ddq_max, self._limits.brake_dddq_max)

    def brake_or_hold(self) -> JointCommand:
        """Continue a stop or a yielding motion that is not over, else hold."""
        self._since_s += CONTROL_PERIOD_S
        if self._stop is not None:
            q, dq = self._stop.at(self._since_s)
            if self._since_s >= self._stop.duration_s:
                self._stop, self.mode, self._hold_q = None, ServoMode.HOLDING, q
            return JointCommand(q, dq)
        if self._move is not None:
            q, dq, _ = self._move.at(self._since_s)
            if self._since_s >= self._move.duration_s:
                self._move, self._hold_q = None, q
            return JointCommand(q, dq)
        return JointCommand(self._hold_q, _ZERO)

    def _clear_motion(self) -> None:
        self._move = self._state = self._escape = None
