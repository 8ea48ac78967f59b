"""The 500 Hz servo above any arm: plays trajectories, enforces limits, brakes, holds, and latches the stop.

Data flow between the producers' threads (left) and the tick's thread (right):

    stream, send, stop, ...  ->  CommandMailbox  ->  ControlCycle  ->  arm
    status, read_state       <-  Snapshot        <-

One thread (or the lock-step clock) calls `tick`; any thread may call the rest. The tick takes no lock: it reads the
mailbox's immutable entries, and publishes one immutable snapshot.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from hal.base.clock import Clock
from hal.base.errors import CommandRejectedError, HalError, HalTimeoutError, NotConnectedError
from hal.base.messages import ArmSetpoint, ArmState, ServoHealth, ServoMode, ServoStatus, TrajectoryChunk
from hal.servo.command_mailbox import CommandMailbox, Snapshot
from hal.servo.control_loop import ControlCycle
from hal.servo.guard import Guard
from hal.servo.limits import ServoLimits, clip_setpoint
from hal.servo.status import PeriodStatistics, StatusLogger, make_health, make_status

if TYPE_CHECKING:
    from hal.base.arm import Arm

log = logging.getLogger(__name__)

_STATE_MAX_AGE_S = 0.2  # 100 ticks; `BusConfig.state_max_age_s` is the same for clients


class Servo:
    """An arm that takes trajectories (`hal.base.arm.ServoedArm`). The steps of a tick are in `hal.servo.control_loop`.

    Args:
        arm: the arm below.
        clock: source of time stamps; never slept on here.
        limits: of the setpoints; None = the Z1's.
        heartbeat_timeout_s: maximum time without a heartbeat of the lease's owner while a trajectory plays [s]. Each
            of `claim`, `stream`, `send` and `heartbeat` counts as one. None when the owner runs in this process and
            cannot be lost without the servo; the lease then never lapses.
        lease_timeout_s: with the arm at rest, another client may claim a lease without a heartbeat for so long [s].
        send_timeout_s: how long a single setpoint is tracked [s].
        guard: keeps the arm above the table, in its workspace and off itself; None checks only the joint limits.
    """

    cycle_type: type[ControlCycle] = ControlCycle
    """The steps of a tick."""

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
        """Real-time resources granted to the thread that ticks, for `health`."""
        self._heartbeat_timeout_s = heartbeat_timeout_s
        self._send_timeout_s = send_timeout_s
        self._mailbox = CommandMailbox(self.limits, None if heartbeat_timeout_s is None else lease_timeout_s, guard)
        self._snapshot: Snapshot | None = None  # replaced by the tick
        self._ticked = False

    # --- Connection -----------------------------------------------------------------------------------------

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
        """Check all further commands by `guard`; call it before the first tick."""
        self._mailbox.guard = guard

    def disconnect(self) -> None:
        """Disconnect the arm, which holds its position. Brake first (`stop`) if it moves; end a `ServoThread` first."""
        self._snapshot = None
        self._mailbox.lease.clear()
        self.arm.disconnect()

    def _connected(self) -> Snapshot:
        snapshot = self._snapshot
        if snapshot is None:
            raise NotConnectedError("the servo")
        return snapshot

    # --- Commands and queries, from any thread ----------------------------------------------------------------

    def read_state(self) -> ArmState:
        """Return the measurement of the last tick; before the first tick, of the arm now.

        Once a thread ticks, only that thread may access the arm: two would interleave on its link.

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
                f"servo: the newest measurement is {age_s:.2f} s old (allowed {_STATE_MAX_AGE_S} s). "
                f"The ticks have ended or the arm is silent: check the log.",
                code="stale_state",
            )
        return snapshot.state

    def claim(self, owner: str) -> None:
        """Claim the command lease (see `hal.base.arm.ServoedArm.claim`)."""
        self._mailbox.claim(owner, self.clock.now_s(), at_rest=self._connected().at_rest)

    def release(self, owner: str | None = None) -> None:
        """Release the lease and brake a running motion. No effect when it is not owned (by `owner`)."""
        self._mailbox.release(owner)

    def heartbeat(self, owner: str | None = None) -> None:
        """Record a heartbeat of the lease's owner.

        Raises:
            LeaseError: `owner` does not own the lease.
        """
        self._mailbox.renew(owner, self.clock.now_s())

    def stop(self, reason: str = "stop requested") -> None:
        """Brake at the next tick, then hold; all commands are rejected until `rearm()`. Queued motion is dropped.

        Waits for nothing, also not for another client's command that is being checked.
        """
        self._mailbox.stop(reason)

    def fail(self, reason: str) -> None:
        """Latch the stop and stop the arm itself; for a thread whose ticks cannot continue."""
        self._mailbox.stop(reason)
        snapshot = self._snapshot
        if snapshot is not None:
            self._snapshot = snapshot._replace(mode=ServoMode.STOPPED, reason=reason)
            self.arm.stop()

    def rearm(self, owner: str | None = None) -> None:
        """Clear a latched stop; the arm holds its position and the lease is free. No effect when not stopped.

        Args:
            owner: client that rearms; None = the operator, in this process.

        Raises:
            LeaseError: `owner` does not own the lease; while the stop is latched it can claim it.
        """
        self._connected()
        self._mailbox.rearm(owner, self.clock.now_s())

    def stream(self, chunk: TrajectoryChunk, owner: str | None = None) -> None:
        """Queue a trajectory chunk (see `hal.base.arm.ServoedArm.stream`).

        Args:
            chunk: the chunk.
            owner: its sender; None = the owner of the lease, in this process.

        Raises:
            NotConnectedError, StoppedError, LeaseError, GuardError, CommandRejectedError: it was not queued; the codes
                are those of `hal.servo.command_mailbox` and `hal.servo.trajectory_buffer`.
        """
        snapshot = self._connected()
        if not isinstance(chunk, TrajectoryChunk):
            raise CommandRejectedError(
                f"servo: stream() takes a TrajectoryChunk, not a {type(chunk).__name__}.", code="wrong_type"
            )
        with _own_error("the chunk"):
            self._mailbox.stream(chunk, owner, self.clock.now_s(), snapshot)

    def send(self, setpoint: ArmSetpoint, owner: str | None = None) -> ArmSetpoint:
        """Move towards one setpoint within all limits; return it clipped to the joint limits and to one tick's step.

        Without another one within `send_timeout_s` the arm holds. For streams of setpoints at the servo's rate;
        slower ones are smoother as a trajectory.

        Raises:
            NotConnectedError, StoppedError, LeaseError: it was not accepted.
            CommandRejectedError: a trajectory is playing.
            GuardError: it is outside the workspace.
        """
        snapshot = self._connected()
        if not isinstance(setpoint, ArmSetpoint):
            raise CommandRejectedError(
                f"servo: send() takes an ArmSetpoint, not a {type(setpoint).__name__}.", code="wrong_type"
            )
        with _own_error("the setpoint"):
            self._mailbox.send(setpoint, owner, self.clock.now_s(), snapshot)
        allowed = clip_setpoint(
            self.limits,
            setpoint.q,
            setpoint.dq,
            q_command=snapshot.q_desired,
            q_last=snapshot.q_sent,
            q_measured=snapshot.state.q,
            dq_measured=snapshot.state.dq,
        )
        return ArmSetpoint(q=allowed.q, dq=allowed.dq)

    def status(self) -> ServoStatus:
        """Return the status after the last tick; built on request, to keep the tick short."""
        snapshot = self._connected()
        now_s = self.clock.now_s()
        self._status_log.log_changes(
            self._mailbox.latch, self._cycle.clipped_count + self._mailbox.out_of_limits_count, now_s
        )
        return make_status(snapshot, self._mailbox, self.periods, now_s)

    def health(self) -> ServoHealth:
        """Return the health: timing, latency of the commands, faults and command authority."""
        from hal.base.arm import CommandLatency, TimedArm

        latency = self.arm.command_latency() if isinstance(self.arm, TimedArm) else CommandLatency()
        return make_health(
            self._connected(),
            self._mailbox,
            self.periods,
            self.clock.now_s(),
            real_time=self.real_time,
            latency=latency,
        )

    # --- The tick -----------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Run one cycle (`hal.servo.control_loop`). Never blocks and never logs.

        Trajectory time advances by exactly one control period a call, however late the call is.

        Raises:
            NotConnectedError: before `connect()`.
        """
        self._connected()
        self._ticked = True
        now_s = self.clock.now_s()
        self.periods.record(now_s)
        self._snapshot = self._cycle.run(now_s)


@contextmanager
def _own_error(what: str) -> Iterator[None]:
    """Turn an unforeseen error into a rejection of the one request that met it.

    Raises:
        CommandRejectedError: instead of any error that is no `HalError` (`internal_error`).
    """
    try:
        yield
    except HalError:
        raise
    except Exception as error:  # every type: a defect must not end the process that holds the arm
        log.exception("servo: an unforeseen error rejected %s", what)
        raise CommandRejectedError(
            f"servo: {what} was not accepted, because of an error in the servo ({type(error).__name__}: {error}). The "
            f"arm goes on as before. Report it with the log of the HAL.",
            code="internal_error",
        ) from error
