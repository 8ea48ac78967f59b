"""The 500 Hz servo above any arm: plays trajectories, enforces limits, brakes, holds, and latches the stop.

Threads: one thread (or the lock-step clock) calls `tick`; any thread may call the rest. The tick takes no lock: what
producers ask for waits in `hal.servo.command_mailbox.CommandMailbox`, what the tick tells them is one immutable snapshot a
tick.
"""

from __future__ import annotations

from hal.base.arm import Arm
from hal.base.clock import Clock
from hal.base.errors import CommandRejectedError, HalError, HalTimeoutError, NotConnectedError
from hal.base.messages import ArmSetpoint, ArmState, ServoHealth, ServoMode, ServoStatus, TrajectoryChunk
from hal.servo.command_mailbox import CommandMailbox, Snapshot
from hal.servo.control_loop import ControlCycle
from hal.servo.guard import Guard
from hal.servo.limits import ServoLimits, clip_setpoint
from hal.servo.periods import PeriodStatistics
from hal.servo.status import StatusLogger, make_health, make_status

_STATE_MAX_AGE_S = 0.2


class Servo:
    """An arm that takes trajectories (`hal.base.arm.ServoedArm`). What a tick does is in `hal.servo.control_loop`.

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

    cycle_type: type[ControlCycle] = ControlCycle
    """What a tick does."""

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
        self._mailbox = CommandMailbox(self.limits, None if heartbeat_timeout_s is None else lease_timeout_s, guard)
        self._snapshot: Snapshot | None = None  # replaced by the tick
        self._ticked = False

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
        self._mailbox.reset()
        self._status_log, self._ticked = StatusLogger(), False
        self._cycle = self.cycle_type(
            self.arm,
            self.limits,
            self._mailbox,
            state,
            heartbeat_timeout_s=self._heartbeat_timeout_s,
            send_timeout_s=self._send_timeout_s,
        )
        self._snapshot = self._cycle.snapshot(self.clock.now_s())

    def set_safety_guard(self, guard: Guard) -> None:
        """Let `guard` check whatever is commanded from now on; for before anything ticks."""
        self._mailbox.guard = guard

    def disconnect(self) -> None:
        """Let go of the arm, which holds where it is. Brake first (`stop`) if it moves; end a `ServoThread` first."""
        self._snapshot = None
        self._mailbox.lease.clear()
        self.arm.disconnect()

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
        """Take the command lease (see `hal.base.arm.ServoedArm.claim`)."""
        self._mailbox.claim(owner, self.clock.now_s(), at_rest=self._connected().at_rest)

    def release(self, owner: str | None = None) -> None:
        """Give the lease back; a running motion is braked first. Harmless when not held (by `owner`)."""
        self._mailbox.release(owner)

    def heartbeat(self, owner: str | None = None) -> None:
        """Say that the lease's owner is alive.

        Raises:
            LeaseError: `owner` does not hold the lease.
        """
        self._mailbox.renew(owner, self.clock.now_s())

    def stop(self, reason: str = "stop requested") -> None:
        """Brake at the next tick, then hold; every command is refused until `rearm()`. Queued motion is dropped."""
        self._mailbox.stop(reason)

    def fail(self, reason: str) -> None:
        """Latch and stop the arm itself: for a driver whose tick cannot go on."""
        self._mailbox.stop(reason)
        snapshot = self._snapshot
        if snapshot is not None:
            self._snapshot = snapshot._replace(mode=ServoMode.STOPPED, reason=reason)
            self.arm.stop()

    def rearm(self) -> None:
        """Lift a latched stop; the arm holds where it is and the lease is free. No effect when not stopped."""
        self._connected()
        self._mailbox.rearm()

    def stream(self, chunk: TrajectoryChunk, owner: str | None = None) -> None:
        """Queue a piece of a trajectory (see `hal.base.arm.ServoedArm.stream`).

        Args:
            chunk: the piece.
            owner: who sends it; None = the current_owner of the lease, in this process.

        Raises:
            NotConnectedError, StoppedError, LeaseError, CommandRejectedError: it was not queued.
        """
        snapshot = self._connected()
        if not isinstance(chunk, TrajectoryChunk):
            raise CommandRejectedError(f"stream() takes a TrajectoryChunk, not a {type(chunk).__name__}.")
        self._mailbox.stream(chunk, owner, self.clock.now_s(), snapshot)

    def send(self, setpoint: ArmSetpoint, owner: str | None = None) -> ArmSetpoint:
        """Move towards one setpoint within all limits; return it clipped to the joints' limits and a tick's reach.

        Without another one within `send_timeout_s` the arm holds. For streams of setpoints at the servo's rate;
        anything slower is smoother as a trajectory.

        Raises:
            NotConnectedError, StoppedError, LeaseError: it was not taken.
            CommandRejectedError: a trajectory is playing, or the guard forbids the place.
        """
        snapshot = self._connected()
        if not isinstance(setpoint, ArmSetpoint):
            raise CommandRejectedError(f"send() takes an ArmSetpoint, not a {type(setpoint).__name__}.")
        self._mailbox.send(setpoint, owner, self.clock.now_s(), snapshot)
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
        self._status_log.log_changes(self._mailbox.latch, self._cycle.clipped_count + self._mailbox.out_of_limits_count, now_s)
        return make_status(snapshot, self._mailbox, self.periods, now_s)

    def health(self) -> ServoHealth:
        """Return how well the servo does its work."""
        return make_health(self._connected(), self._mailbox, self.periods, self.real_time, self.clock.now_s())

    # --- The tick -----------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Run one cycle (`hal.servo.control_loop`). Never blocks and never logs.

        Trajectory time moves on by exactly one control period a call, however late the call is.

        Raises:
            NotConnectedError: before `connect()`.
        """
        self._connected()
        self._ticked = True
        now_s = self.clock.now_s()
        self.periods.record(now_s)
        self._snapshot = self._cycle.run(now_s)
