"""One cycle of the 500 Hz control loop: measure, check, choose the command, limit it, send it.

    state = arm.read_state()                           faults, overload, blocked joints -> latch the stop
    command = stop > trajectory > setpoint > hold      heartbeat late, underrun, guard -> brake
    setpoint = clip_setpoint(command)                  joint limits, grip torque, step
    arm.send(setpoint)

Nothing in it blocks, logs or takes a lock. The motions themselves are in `setpoint_generator`, the stops in `braking`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hal.base.errors import HalError
from hal.base.messages import ArmSetpoint, ArmState, ServoMode
from hal.base.z1 import N_ARM
from hal.servo.command_mailbox import CommandMailbox, Snapshot
from hal.servo.limits import OverloadDetector, ServoLimits, clip_setpoint, compute_servo_torque, find_blocked
from hal.servo.setpoint_generator import JointCommand, SetpointGenerator
from hal.servo.trajectory_buffer import TrajectoryBuffer

if TYPE_CHECKING:
    from hal.base.arm import Arm


class ControlCycle:
    """The tick's private state and its steps; used by the tick's thread alone.

    Args:
        arm: connected.
        limits: of the setpoints.
        mailbox: commands of the producers; its guard checks each step towards a single setpoint.
        state: measurement of the arm, whose position is held at first.
        heartbeat_timeout_s: see `hal.servo.servo.Servo`.
        send_timeout_s: see `hal.servo.servo.Servo`.
    """

    def __init__(
        self,
        arm: Arm,
        limits: ServoLimits,
        mailbox: CommandMailbox,
        state: ArmState,
        *,
        heartbeat_timeout_s: float | None,
        send_timeout_s: float,
    ) -> None:
        self._arm, self._limits, self._mailbox = arm, limits, mailbox
        self._heartbeat_timeout_s, self._send_timeout_s = heartbeat_timeout_s, send_timeout_s
        self._motion = SetpointGenerator(limits, state.q, self._find_violation)
        self._overload = OverloadDetector(limits)
        self._state, self._q_sent = state, state.q
        self._link_lost = self._yield_pending = self._has_yielded = False
        self.clipped_count = 0
        """Number of setpoints that the limits have changed."""

    def run(self, now_s: float) -> Snapshot:
        """Run one cycle; trajectory time advances by exactly one control period, however late the call is."""
        self._measure()
        self._command(now_s)
        return self.snapshot(now_s)

    def snapshot(self, now_s: float) -> Snapshot:
        """Return the result of the last cycle for other threads."""
        motion = self._motion
        # A stop may arrive in the middle of a tick: an arm that still tracks is not stopped yet.
        stopped = bool(self._mailbox.latch) and motion.mode is ServoMode.HOLDING
        return Snapshot(
            stamp_s=now_s,
            mode=ServoMode.STOPPED if stopped else motion.mode,
            reason=self._mailbox.latch or motion.reason,
            trajectory_id=motion.trajectory_id,
            trajectory_time_s=max(motion.trajectory_time_s, 0.0),
            finished=motion.finished,
            q_sent=self._q_sent,
            q_desired=motion.q,
            state=self._state,
        )

    # --- Measure and check --------------------------------------------------------------------------------------

    def _measure(self) -> None:
        """Read the arm; latch the stop at a lost state, a reported fault, an overload or a blocked joint."""
        try:
            state = self._arm.read_state()
        except HalError as error:
            self._latch_fault(f"the arm's state is lost: {error}")
            return
        self._state = state
        if state.faults:
            self._latch_fault(f"the arm reports {', '.join(state.faults)}")
            return
        overload = self._overload.update(state.tau, compute_servo_torque(self._q_sent, state.q))
        blocked = overload or find_blocked(self._limits, self._q_sent, state.q)
        if blocked:
            # Holding the command would go on pushing: once at rest, the arm holds its measured position instead. Only
            # once until it is re-armed, so that a permanent load does not drag the arm along.
            if not self._has_yielded:
                self._yield_pending = self._has_yielded = True
            self._latch_fault(blocked)

    def _latch_fault(self, reason: str) -> None:
        """Latch the stop, as `Servo.stop` does: an operator has to inspect the arm before it moves again."""
        self._mailbox.stop(reason)

    # --- Choose the command -------------------------------------------------------------------------------------

    def _command(self, now_s: float) -> None:
        """Command the arm."""
        self._send_command(*self._select_command(now_s))

    def _select_command(self, now_s: float) -> JointCommand:
        """Return the command by priority: latched stop, trajectory, single setpoint, hold."""
        motion, mailbox = self._motion, self._mailbox
        if mailbox.rearm_pending:
            mailbox.rearm_pending = self._link_lost = self._has_yielded = False
            self._yield_pending, motion.reason = True, ""
        if mailbox.finished_id > motion.trajectory_id:
            motion.skip(mailbox.finished_id, mailbox.cancel_reason)
        # Read once: a producer may replace any of them while this runs.
        newest, active, target = mailbox.trajectory, mailbox.active_trajectory, mailbox.target
        if mailbox.latch:
            mailbox.finish(newest)
            mailbox.target = None
            if motion.mode is ServoMode.TRACKING:
                motion.brake(mailbox.latch)
        elif active is not None:
            return self._follow_trajectory(active, now_s)
        elif motion.mode is ServoMode.BRAKING:
            pass  # a setpoint waits until the arm is at rest
        elif target is not None and now_s - target.stamp_s <= self._send_timeout_s:
            return self._track_target(target.setpoint.q)
        elif motion.mode is ServoMode.TRACKING:
            motion.brake("" if target else mailbox.cancel_reason)
            mailbox.target = None
        if self._yield_pending and motion.mode is ServoMode.HOLDING:
            self._yield_pending = False
            motion.yield_to_measured(self._state.q)
        return motion.brake_or_hold()

    def _follow_trajectory(self, active: TrajectoryBuffer, now_s: float) -> JointCommand:
        """Play the active trajectory; brake on its path at a late heartbeat, a blocked chunk or an underrun."""
        motion, mailbox = self._motion, self._mailbox
        reason = self._heartbeat_fault(now_s) or mailbox.blocked_trajectories.get(active.trajectory_id, "")
        is_new = active.trajectory_id != motion.trajectory_id
        if not reason and not is_new and motion.has_underrun(active):
            reason = f"trajectory {active.trajectory_id}: buffer underrun at {active.end_s:.3f} s"
        if reason:
            mailbox.finish(active)
            if motion.mode is ServoMode.TRACKING:
                motion.brake(reason)
            if is_new:
                motion.skip(active.trajectory_id, reason)
            return motion.brake_or_hold()
        if is_new and motion.is_moving:  # what moves comes to rest first, on the path that was checked
            if motion.mode is ServoMode.TRACKING:
                motion.brake(f"trajectory {active.trajectory_id} replaces the motion")
            return motion.brake_or_hold()
        if is_new:
            motion.begin(active, self._q_sent)
        command = motion.play(active)
        if motion.mode is not ServoMode.TRACKING:  # at its end, or stopped by the guard
            mailbox.finish(active)
        return command

    def _track_target(self, q_target: np.ndarray) -> JointCommand:
        """Move towards a setpoint; brake while a stop still ends inside the guard's workspace."""
        command = self._motion.track(q_target)
        if self._motion.mode is not ServoMode.TRACKING:
            self._mailbox.target = None
        return command

    def _find_violation(self, q: np.ndarray) -> str:
        """Return how the postures `q` (N, 7) violate the guard; empty when they do not, or without a guard."""
        guard = self._mailbox.guard
        violation = guard.find_violation(q, self._q_sent) if guard is not None else None
        return "" if violation is None else violation.text

    def _heartbeat_fault(self, now_s: float) -> str:
        """Return a description of a late heartbeat; empty when it is in time or not required."""
        lease, allowed_s = self._mailbox.lease, self._heartbeat_timeout_s
        silent_s = now_s - lease.last_heartbeat_s
        if allowed_s is None or silent_s <= allowed_s:
            return ""
        return f"no heartbeat from {lease.owner!r} for {silent_s:.3f} s (allowed {allowed_s} s)"

    # --- Limit and send -----------------------------------------------------------------------------------------

    def _send_command(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Clip the command, record it as the start of the next one, and send it unless the link is lost."""
        state = self._state
        allowed = clip_setpoint(
            self._limits,
            q,
            dq,
            q_command=self._motion.q,
            q_last=self._q_sent,
            q_measured=state.q,
            dq_measured=state.dq,
        )
        self.clipped_count += allowed.clipped
        # The gripper's squeeze limit is left out of the record: the next motion starts from the grip as commanded.
        q_recorded, dq_recorded = allowed.q.copy(), allowed.dq.copy()
        q_recorded[N_ARM], dq_recorded[N_ARM] = q[N_ARM], dq[N_ARM]
        self._motion.update_last_command(q_recorded, dq_recorded)
        if self._link_lost:
            return
        try:
            self._q_sent = self._arm.send(ArmSetpoint(q=allowed.q, dq=allowed.dq)).q
        except HalError as error:
            self._latch_fault(f"the arm takes no commands: {error}")
            self._link_lost = True


class MonitorOnlyCycle(ControlCycle):
    """A cycle that commands nothing: the reported command is the measurement."""

    def _command(self, now_s: float) -> None:
        self._q_sent = self._motion.q = self._state.q
