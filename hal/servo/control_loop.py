"""One cycle of the servo: measure, choose the setpoint, limit it, send it, tell."""

from __future__ import annotations

import numpy as np

from hal.base.arm import Arm
from hal.base.errors import HalError
from hal.base.messages import ArmSetpoint, ArmState, ServoMode
from hal.base.z1 import N_ARM
from hal.servo.command_mailbox import CommandMailbox, Snapshot
from hal.servo.limits import OverloadDetector, ServoLimits, clip_setpoint, find_blocked, compute_servo_torque
from hal.servo.setpoint_generator import SetpointGenerator, JointCommand
from hal.servo.trajectory_buffer import TrajectoryBuffer


class ControlCycle:
    """What the tick's thread alone does and knows; never blocks and never logs.

    Args:
        arm: what is moved; connected.
        limits: what is allowed.
        orders: what the producers want; its guard checks each step towards a single setpoint.
        state: the arm as measured now, which it holds at first.
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
        self._motion = SetpointGenerator(limits, state.q)
        self._overload = OverloadDetector(limits)
        self._state, self._q_sent = state, state.q
        self._link_lost = self._yield_pending = self._has_yielded = False
        self.clipped_count = 0
        """How many setpoints the limits have changed."""

    def run(self, now_s: float) -> Snapshot:
        """Run one cycle; trajectory time moves on by exactly one control period, however late the call is."""
        self._measure()
        self._act(now_s)
        return self.snapshot(now_s)

    def snapshot(self, now_s: float) -> Snapshot:
        """Return what there is to tell."""
        motion = self._motion
        # A stop may come in the middle of a tick: what still tracks is not stopped yet.
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

    def _measure(self) -> None:
        try:
            state = self._arm.read_state()
        except HalError as error:
            self._fault(f"the arm's state is lost: {error}")
            return
        self._state = state
        if state.faults:
            self._fault(f"the arm reports {', '.join(state.faults)}")
            return
        overload = self._overload.update(state.tau, compute_servo_torque(self._q_sent, state.q))
        blocked = overload or find_blocked(self._limits, self._q_sent, state.q)
        if blocked:
            # Holding the command would go on pushing: once at rest, the arm holds what it measures instead. Only
            # once until it is re-armed, lest a load that does not end pull it along.
            if not self._has_yielded:
                self._yield_pending = self._has_yielded = True
            self._fault(blocked)

    def _fault(self, reason: str) -> None:
        """Latch, as `Servo.stop` does: somebody has to look at the arm before it moves again."""
        mailbox = self._mailbox
        if not mailbox.latch:
            mailbox.cancel_reason = reason
            mailbox.latch = reason

    def _act(self, now_s: float) -> None:
        """Command the arm."""
        self._send_command(*self._select_command(now_s))

    def _select_command(self, now_s: float) -> JointCommand:
        motion, mailbox = self._motion, self._mailbox
        if mailbox.rearmed:
            mailbox.rearmed = self._link_lost = self._has_yielded = False
            self._yield_pending, motion.reason = True, ""
        if mailbox.finished_id > motion.trajectory_id:
            motion.skip(mailbox.finished_id, mailbox.cancel_reason)
        # Read once: a producer may replace any of them while this runs.
        newest, current, target = mailbox.trajectory, mailbox.active_trajectory, mailbox.target
        if mailbox.latch:
            mailbox.finish(newest)
            mailbox.target = None
            if motion.mode is ServoMode.TRACKING:
                motion.brake(mailbox.latch, newest)
        elif current is not None:
            return self._follow_trajectory(current, now_s)
        elif target is not None and now_s - target.stamp_s <= self._send_timeout_s:
            return self._track_target(target.setpoint.q)
        elif motion.mode is ServoMode.TRACKING:
            motion.brake("" if target else mailbox.cancel_reason, newest)
            mailbox.target = None
        if self._yield_pending and motion.mode is ServoMode.HOLDING:
            self._yield_pending = False
            motion.yield_to_measured(self._state.q)
        return motion.rest()

    def _follow_trajectory(self, current: TrajectoryBuffer, now_s: float) -> JointCommand:
        motion, mailbox = self._motion, self._mailbox
        if current.trajectory_id != motion.trajectory_id:
            motion.begin(current)
        why = self._heartbeat_fault(now_s) or mailbox.blocked_trajectories.get(current.trajectory_id, "")
        if why or motion.has_underrun(current):
            mailbox.finish(current)
            motion.brake(why or f"trajectory {current.trajectory_id} ran dry at {current.end_s:.3f} s", current)
            return motion.rest()
        wish = motion.play(current)
        if motion.finished:
            mailbox.finish(current)
        return wish

    def _track_target(self, q_target: np.ndarray) -> JointCommand:
        """Move towards a setpoint; brake where going on could no longer be stopped inside the guard's space."""
        motion, guard = self._motion, self._mailbox.guard
        wish = motion.track(q_target)
        if guard is not None:
            ahead = np.array([wish[0], motion.predict_rest_position()])
            if refusal := guard.refusal(ahead, self._q_sent):
                self._mailbox.target = None
                motion.brake(f"the way to the setpoint {refusal[1]}")
                return motion.rest()
        return wish

    def _heartbeat_fault(self, now_s: float) -> str:
        lease, allowed_s = self._mailbox.lease, self._heartbeat_timeout_s
        silent_s = now_s - lease.last_heartbeat_s
        if allowed_s is None or silent_s <= allowed_s:
            return ""
        return f"no heartbeat from {lease.owner!r} for {silent_s:.3f} s (allowed {allowed_s} s)"

    def _send_command(self, q: np.ndarray, dq: np.ndarray) -> None:
        state = self._state
        allowed = clip_setpoint(self._limits, q, dq, q_last=self._q_sent, q_measured=state.q, dq_measured=state.dq)
        self.clipped_count += allowed.clipped
        noted = np.minimum(np.maximum(q, self._limits.q_min), self._limits.q_max)
        noted[:N_ARM] = allowed.q[:N_ARM]
        self._motion.update_last_command(noted, np.append(allowed.dq[:N_ARM], dq[N_ARM]))
        if self._link_lost:
            return
        try:
            self._q_sent = self._arm.send(ArmSetpoint(q=allowed.q, dq=allowed.dq)).q
        except HalError as error:
            self._fault(f"the arm takes no commands: {error}")
            self._link_lost = True


class MonitorOnlyCycle(ControlCycle):
    """A cycle that commands nothing: what the arm does is what it was told."""

    def _act(self, now_s: float) -> None:
        self._q_sent = self._motion.q = self._state.q
