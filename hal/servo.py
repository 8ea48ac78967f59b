"""The 500 Hz servo above any arm: plays trajectories, enforces limits, brakes, holds, and latches the stop.

Threads: one thread (or the lock-step clock) calls `tick`; any thread may call the rest. The tick takes no lock: what
producers ask for waits in `hal.orders.Orders`, what the tick tells them is one immutable snapshot a tick.
"""

from __future__ import annotations

import numpy as np

from hal.arm import Arm
from hal.clock import Clock
from hal.errors import CommandRefusedError, HalError, HalTimeoutError, NotConnectedError
from hal.guard import Guard
from hal.limits import OverloadWatch, ServoLimits, clip_setpoint, find_blocked, servo_torque
from hal.messages import ArmSetpoint, ArmState, ServoHealth, ServoMode, ServoStatus, TrajectoryChunk
from hal.motion import Motion, Wish
from hal.orders import Orders, Snapshot
from hal.periods import PeriodStatistics
from hal.playback import Playback
from hal.servo_status import Teller, make_health, make_status
from hal.z1 import N_ARM

_STATE_MAX_AGE_S = 0.2


class Servo:
    """An arm that takes trajectories (`hal.arm.ServoedArm`).

    Args:
        arm: what is moved.
        clock: what time it is; never slept on here.
        limits: what is allowed.
        heartbeat_timeout_s: how long the lease's owner may be silent while a trajectory plays [s]. A heartbeat is
            any of `claim`, `stream`, `send`, `heartbeat`. None when the owner lives in this process and cannot be
            lost without the servo; the lease then never lapses.
        lease_timeout_s: with the arm at rest, a lease silent for so long [s] may be claimed by another.
        send_timeout_s: how long a single setpoint is followed [s].
        guard: keeps the arm above the table, in its workspace and off itself; None leaves the joint limits alone.
    """

    def __init__(
        self,
        arm: Arm,
        clock: Clock,
        limits: ServoLimits | None = None,
        *,
        heartbeat_timeout_s: float | None = None,
        lease_timeout_s: float = 1.0,
        send_timeout_s: float = 0.1,
        guard: Guard | None = None,
    ) -> None:
        self.arm = arm
        self.clock = clock
        self.limits = limits or ServoLimits()
        self.periods = PeriodStatistics()
        self.real_time: tuple[str, ...] = ()
        """What the thread that ticks was granted, for `health`."""
        self._heartbeat_timeout_s = heartbeat_timeout_s
        self._send_timeout_s = send_timeout_s
        self._guard = guard
        self._orders = Orders(self.limits, None if heartbeat_timeout_s is None else lease_timeout_s, guard)
        # Written by the tick.
        self._snapshot: Snapshot | None = None
        self._ticked = False
        self._clips = 0
        self._teller = Teller()

    # --- Life -----------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Connect the arm and hold it where it is; the lease is free and no stop is latched.

        Raises:
            HalTimeoutError: the arm does not answer; nothing is left open.
        """
        if self._snapshot is not None:
            return
        self.arm.connect()
        try:
            state = self.arm.read_state()
        except HalError:
            self.arm.disconnect()
            raise
        self._orders.reset()
        self._reset(state)

    def keep_inside(self, guard: Guard) -> None:
        """Let `guard` check whatever is commanded from now on; for before anything ticks."""
        self._guard = self._orders.guard = guard

    def disconnect(self) -> None:
        """Let go of the arm, which holds where it is. Brake first (`stop`) if it moves; end a `ServoThread` first."""
        self._snapshot = None
        self._orders.lease.clear()
        self.arm.disconnect()

    def _reset(self, state: ArmState) -> None:
        self._motion = Motion(self.limits, state.q)
        self._overload = OverloadWatch(self.limits)
        self._state, self._q_sent = state, state.q
        self._link_lost = self._give_way = self._gave_way = self._ticked = False
        self._publish(self.clock.now_s())

    def _connected(self) -> Snapshot:
        snapshot = self._snapshot
        if snapshot is None:
            raise NotConnectedError("the servo")
        return snapshot

    # --- What anybody may call, from any thread ---------------------------------------------------------------

    def read_state(self) -> ArmState:
        """Return the measurement of the last tick; before the first tick, ask the arm.

        Once something ticks, the arm belongs to that thread: a second one would drive it at the same time.

        Raises:
            NotConnectedError: before `connect()`.
            HalTimeoutError: the newest measurement is too old to be trusted.
        """
        snapshot = self._connected()
        if not self._ticked:
            return self.arm.read_state()
        age_s = self.clock.now_s() - snapshot.state.stamp_s
        if age_s > _STATE_MAX_AGE_S:
            raise HalTimeoutError(
                f"the servo's newest measurement is {age_s:.2f} s old; allowed is {_STATE_MAX_AGE_S} s. "
                f"Its ticks have ended or the arm is silent: look at the log."
            )
        return snapshot.state

    def claim(self, owner: str) -> None:
        """Take the command lease (see `hal.arm.ServoedArm.claim`)."""
        self._orders.claim(owner, self.clock.now_s(), at_rest=self._connected().at_rest)

    def release(self, owner: str | None = None) -> None:
        """Give the lease back; a running motion is braked first. Harmless when not held (by `owner`)."""
        self._orders.release(owner)

    def heartbeat(self, owner: str | None = None) -> None:
        """Say that the lease's owner is alive.

        Raises:
            LeaseError: `owner` does not hold the lease.
        """
        self._orders.beat(owner, self.clock.now_s())

    def stop(self, reason: str = "stop requested") -> None:
        """Brake at the next tick, then hold; every command is refused until `rearm()`. Queued motion is dropped."""
        self._orders.stop(reason)

    def fail(self, reason: str) -> None:
        """Latch and stop the arm itself: for a driver whose tick cannot go on."""
        self._orders.stop(reason)
        snapshot = self._snapshot
        if snapshot is not None:
            self._snapshot = snapshot._replace(mode=ServoMode.STOPPED, reason=reason)
            self.arm.stop()

    def rearm(self) -> None:
        """Lift a latched stop; the arm holds where it is and the lease is free. No effect when not stopped."""
        self._connected()
        self._orders.rearm()

    def stream(self, chunk: TrajectoryChunk, owner: str | None = None) -> None:
        """Queue a piece of a trajectory (see `hal.arm.ServoedArm.stream`).

        Args:
            chunk: the piece.
            owner: who sends it; None = the holder of the lease, in this process.

        Raises:
            NotConnectedError, StoppedError, LeaseError, CommandRefusedError: it was not queued.
        """
        snapshot = self._connected()
        if not isinstance(chunk, TrajectoryChunk):
            raise CommandRefusedError(f"stream() takes a TrajectoryChunk, not a {type(chunk).__name__}.")
        self._orders.stream(chunk, owner, self.clock.now_s(), snapshot)

    def send(self, setpoint: ArmSetpoint, owner: str | None = None) -> ArmSetpoint:
        """Move towards one setpoint within all limits; return it clipped to the joints' limits and a tick's reach.

        Without another one within `send_timeout_s` the arm holds. For streams of setpoints at the servo's rate;
        anything slower is smoother as a trajectory.

        Raises:
            NotConnectedError, StoppedError, LeaseError: it was not taken.
            CommandRefusedError: a trajectory is playing, or the guard forbids the place.
        """
        snapshot = self._connected()
        if not isinstance(setpoint, ArmSetpoint):
            raise CommandRefusedError(f"send() takes an ArmSetpoint, not a {type(setpoint).__name__}.")
        self._orders.send(setpoint, owner, self.clock.now_s(), snapshot)
        allowed = clip_setpoint(
            self.limits,
            setpoint.q,
            setpoint.dq,
            q_last=snapshot.q_sent,
            q_measured=snapshot.state.q,
            dq_measured=snapshot.state.dq,
        )
        return ArmSetpoint(q=allowed.q, dq=allowed.dq)

    def status(self) -> ServoStatus:
        """Return the servo's account of its last tick; built on request, so that the tick need not."""
        snapshot = self._connected()
        now_s = self.clock.now_s()
        self._teller.tell(self._orders.latch, self._clips + self._orders.beyond, now_s)
        return make_status(snapshot, self._orders, self.periods, now_s)

    def health(self) -> ServoHealth:
        """Return how well the servo does its work."""
        return make_health(self._connected(), self._orders, self.periods, self.real_time, self.clock.now_s())

    # --- The tick -----------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """One cycle: measure, choose the setpoint, limit it, send it. Never blocks and never logs.

        Trajectory time moves on by exactly one control period a call, however late the call is.

        Raises:
            NotConnectedError: before `connect()`.
        """
        self._connected()
        self._ticked = True
        now_s = self.clock.now_s()
        self.periods.record(now_s)
        self._measure()
        self._act(now_s)
        self._publish(now_s)

    def _act(self, now_s: float) -> None:
        """Command the arm for this cycle."""
        self._command(*self._choose(now_s))

    def _measure(self) -> None:
        try:
            state = self.arm.read_state()
        except HalError as error:
            self._fault(f"the arm's state is lost: {error}")
            return
        self._state = state
        if state.faults:
            self._fault(f"the arm reports {', '.join(state.faults)}")
            return
        overload = self._overload.update(state.tau, servo_torque(self._q_sent, state.q))
        blocked = overload or find_blocked(self.limits, self._q_sent, state.q)
        if blocked:
            # Holding the command would go on pushing: once at rest, the arm holds what it measures instead. Only
            # once until it is re-armed, lest a load that does not end pull it along.
            if not self._gave_way:
                self._give_way = self._gave_way = True
            self._fault(blocked)

    def _fault(self, reason: str) -> None:
        """Latch, as `stop` does: somebody has to look at the arm before it moves again."""
        orders = self._orders
        if not orders.latch:
            orders.cancel_reason = reason
            orders.latch = reason

    def _choose(self, now_s: float) -> Wish:
        motion, orders = self._motion, self._orders
        if orders.rearmed:
            orders.rearmed = self._link_lost = self._gave_way = False
            self._give_way, motion.reason = True, ""
        if orders.done_id > motion.trajectory_id:
            motion.skip(orders.done_id, orders.cancel_reason)
        # Read once: a producer may replace any of them while this runs.
        newest, current, target = orders.playback, orders.current, orders.target
        if orders.latch:
            orders.finish(newest)
            orders.target = None
            if motion.mode is ServoMode.TRACKING:
                motion.brake(orders.latch, newest)
        elif current is not None:
            return self._follow(current, now_s)
        elif target is not None and now_s - target.stamp_s <= self._send_timeout_s:
            return self._chase(target.setpoint.q)
        elif motion.mode is ServoMode.TRACKING:
            motion.brake("" if target else orders.cancel_reason, newest)
            orders.target = None
        if self._give_way and motion.mode is ServoMode.HOLDING:
            self._give_way = False
            motion.give_way(self._state.q)
        return motion.rest()

    def _follow(self, current: Playback, now_s: float) -> Wish:
        motion = self._motion
        if current.trajectory_id != motion.trajectory_id:
            motion.begin(current)
        orders = self._orders
        why = self._lateness(now_s) or orders.dead_end.get(current.trajectory_id, "")
        if why or motion.runs_dry(current):
            orders.finish(current)
            motion.brake(why or f"trajectory {current.trajectory_id} ran dry at {current.end_s:.3f} s", current)
            return motion.rest()
        wish = motion.play(current)
        if motion.finished:
            self._orders.finish(current)
        return wish

    def _chase(self, q_target: np.ndarray) -> Wish:
        """Move towards a setpoint; brake where going on could no longer be stopped inside the guard's space."""
        motion = self._motion
        wish = motion.chase(q_target)
        if self._guard is not None:
            ahead = np.array([wish[0], motion.find_rest()])
            if refusal := self._guard.refusal(ahead, self._q_sent):
                self._orders.target = None
                motion.brake(f"the way to the setpoint {refusal[1]}")
                return motion.rest()
        return wish

    def _lateness(self, now_s: float) -> str:
        lease, allowed_s = self._orders.lease, self._heartbeat_timeout_s
        silent_s = now_s - lease.beat_s
        if allowed_s is None or silent_s <= allowed_s:
            return ""
        return f"no heartbeat from {lease.owner!r} for {silent_s:.3f} s (allowed {allowed_s} s)"

    def _command(self, q: np.ndarray, dq: np.ndarray) -> None:
        state = self._state
        allowed = clip_setpoint(self.limits, q, dq, q_last=self._q_sent, q_measured=state.q, dq_measured=state.dq)
        self._clips += allowed.clipped
        noted = np.minimum(np.maximum(q, self.limits.q_min), self.limits.q_max)
        noted[:N_ARM] = allowed.q[:N_ARM]
        self._motion.take_note(noted, np.append(allowed.dq[:N_ARM], dq[N_ARM]))
        if self._link_lost:
            return
        try:
            self._q_sent = self.arm.send(ArmSetpoint(q=allowed.q, dq=allowed.dq)).q
        except HalError as error:
            self._fault(f"the arm takes no commands: {error}")
            self._link_lost = True

    def _publish(self, now_s: float) -> None:
        motion = self._motion
        # A stop may come in the middle of a tick: what still tracks is not stopped yet.
        stopped = bool(self._orders.latch) and motion.mode is ServoMode.HOLDING
        self._snapshot = Snapshot(
            stamp_s=now_s,
            mode=ServoMode.STOPPED if stopped else motion.mode,
            reason=self._orders.latch or motion.reason,
            trajectory_id=motion.trajectory_id,
            time_s=max(motion.time_s, 0.0),
            finished=motion.finished,
            q_sent=self._q_sent,
            q_wanted=motion.q,
            state=self._state,
        )
