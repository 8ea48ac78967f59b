"""The 500 Hz servo above any arm: plays trajectories, enforces limits, brakes, holds, and latches the stop.

Threads: one thread (or the lock-step clock) calls `tick`; any thread may call the rest. The tick takes no lock. What
others hand it are single attributes holding immutable objects (`_playback`, `_target`, `_latch`, `_done_id`), which
Python replaces atomically; `_lock` only keeps the producers apart. What the tick tells others is one immutable
snapshot a tick. A stop therefore takes effect at the next tick whatever else is going on.
"""

from __future__ import annotations

import logging
from threading import Lock
from typing import NamedTuple

import numpy as np

from hal import playback
from hal.arm import Arm
from hal.braking import Blend, Brake, StopPath
from hal.clock import Clock
from hal.errors import CommandRefusedError, HalError, NotConnectedError, StoppedError
from hal.lease import Lease
from hal.limits import OverloadWatch, ServoLimits, clip_setpoint, find_blocked
from hal.messages import ArmSetpoint, ArmState, ServoMode, ServoStatus, TrajectoryChunk
from hal.periods import PeriodStatistics
from hal.servo_thread import ServoThread  # noqa: F401  (the servo and its driver are imported from one place)
from hal.z1 import CONTROL_PERIOD_S, JOINT_NAMES, N_ARM, N_JOINTS

log = logging.getLogger(__name__)

_AT_REST_RAD_S = 0.02
_GIVE_WAY_RAD = 0.01
_WARN_EVERY_S = 1.0
_ZERO = np.zeros(N_JOINTS)
_ZERO.setflags(write=False)


class _Snapshot(NamedTuple):
    """What the tick publishes; replaced as a whole."""

    stamp_s: float
    mode: ServoMode
    reason: str
    trajectory_id: int
    time_s: float
    finished: bool
    q_sent: np.ndarray
    q_wanted: np.ndarray
    state: ArmState


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
    ) -> None:
        self.arm = arm
        self.clock = clock
        self.limits = limits or ServoLimits()
        self.periods = PeriodStatistics()
        self._heartbeat_timeout_s = heartbeat_timeout_s
        self._send_timeout_s = send_timeout_s
        self._brake = Brake(self.limits)
        self._overload = OverloadWatch(self.limits)
        self._lease = Lease(None if heartbeat_timeout_s is None else lease_timeout_s)
        self._lock = Lock()
        # Written by producers, read by the tick.
        self._playback: playback.Playback | None = None
        self._target: tuple[ArmSetpoint, float] | None = None
        self._latch = ""
        self._done_id = 0
        self._cancel_reason = ""
        self._rearmed = False
        # Written by the tick.
        self._snapshot: _Snapshot | None = None
        self._clips = 0
        # Read and written by whoever asks for the status.
        self._clips_told = 0
        self._told_s = -np.inf

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
        with self._lock:
            self._playback = self._target = None
            self._latch, self._cancel_reason, self._rearmed, self._done_id = "", "", False, 0
            self._lease.clear()
        self._reset(state)

    def disconnect(self) -> None:
        """Let go of the arm, which holds where it is. Brake first (`stop`) if it moves; end a `ServoThread` first."""
        self._snapshot = None
        self._lease.clear()
        self.arm.disconnect()

    def _reset(self, state: ArmState) -> None:
        self._mode = ServoMode.HOLDING
        self._reason = ""
        self._trajectory_id = 0
        self._time_s = 0.0
        self._finished = False
        self._link_lost = self._give_way = False
        self._state = state
        self._q = self._q_sent = self._hold_q = state.q
        self._dq = self._ddq = _ZERO
        self._stop_path: StopPath | None = None
        self._blend: Blend | None = None
        self._since_s = 0.0  # since the stop path or the blend began, counted in ticks
        self._publish(self.clock.now_s())

    def _connected(self) -> _Snapshot:
        snapshot = self._snapshot
        if snapshot is None:
            raise NotConnectedError("the servo")
        return snapshot

    # --- What anybody may call, from any thread ---------------------------------------------------------------

    def read_state(self) -> ArmState:
        """Return the measurement of the last tick; when nothing ticks, ask the arm.

        Raises:
            NotConnectedError: before `connect()`.
            HalTimeoutError: the newest measurement is too old to be trusted.
        """
        snapshot = self._connected()
        if self.clock.now_s() - snapshot.state.stamp_s <= 2.5 * CONTROL_PERIOD_S:
            return snapshot.state
        return self.arm.read_state()

    def claim(self, owner: str) -> None:
        """Take the command lease (see `hal.arm.ServoedArm.claim`)."""
        snapshot = self._connected()
        with self._lock:
            at_rest = snapshot.mode in (ServoMode.HOLDING, ServoMode.STOPPED)
            self._lease.claim(owner, self.clock.now_s(), at_rest=at_rest)

    def release(self, owner: str | None = None) -> None:
        """Give the lease back; a running motion is braked first. Harmless when not held (by `owner`)."""
        with self._lock:
            if self._lease.owner and owner in (None, self._lease.owner):
                self._cancel(f"{self._lease.owner!r} released the arm in motion")
                self._lease.clear()

    def heartbeat(self, owner: str | None = None) -> None:
        """Say that the lease's owner is alive.

        Raises:
            LeaseError: `owner` does not hold the lease.
        """
        with self._lock:
            self._lease.beat(owner, self.clock.now_s())

    def stop(self, reason: str = "stop requested") -> None:
        """Brake at the next tick, then hold; every command is refused until `rearm()`. Queued motion is dropped."""
        with self._lock:
            self._latch = self._latch or reason
            self._cancel(reason)

    def fail(self, reason: str) -> None:
        """Latch and stop the arm itself: for a driver whose tick cannot go on."""
        self.stop(reason)
        snapshot = self._snapshot
        if snapshot is not None:
            self._snapshot = snapshot._replace(mode=ServoMode.STOPPED, reason=reason)
            self.arm.stop()

    def rearm(self) -> None:
        """Lift a latched stop; the arm holds where it is and the lease is free. No effect when not stopped."""
        self._connected()
        with self._lock:
            if self._latch:
                self._latch = ""
                self._lease.clear()
                self._rearmed = True

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
        with self._lock:
            self._admit(owner)
            old = self._playback
            newest = max(self._done_id, old.trajectory_id if old else 0)
            running = old is not None and old.trajectory_id > self._done_id
            if running and old is not None and chunk.trajectory_id == old.trajectory_id:
                played_s = snapshot.time_s if snapshot.trajectory_id == old.trajectory_id else 0.0
                self._playback = playback.extend(old, chunk, played_s, self.limits)
                return
            if chunk.trajectory_id <= newest:
                raise CommandRefusedError(
                    f"trajectory {chunk.trajectory_id} is over ({snapshot.reason or 'played or replaced'}); "
                    f"the next one is {newest + 1} or more."
                )
            self._check_start(chunk, snapshot)
            self._playback = playback.begin(chunk, self.limits)

    def send(self, setpoint: ArmSetpoint, owner: str | None = None) -> ArmSetpoint:
        """Follow one setpoint, at most `dq_max` fast; return what the limits leave of it for the next tick.

        Without another one within `send_timeout_s` the arm holds. For streams of setpoints at the servo's rate;
        anything slower is smoother as a trajectory.

        Raises:
            NotConnectedError, StoppedError, LeaseError: it was not taken.
            CommandRefusedError: a trajectory is playing.
        """
        snapshot = self._connected()
        if not isinstance(setpoint, ArmSetpoint):
            raise CommandRefusedError(f"send() takes an ArmSetpoint, not a {type(setpoint).__name__}.")
        with self._lock:
            self._admit(owner)
            old = self._playback
            if old is not None and old.trajectory_id > self._done_id:
                raise CommandRefusedError(f"trajectory {old.trajectory_id} is playing; let it end or release() it.")
            self._target = (setpoint, self.clock.now_s())
        allowed = clip_setpoint(self.limits, setpoint.q, setpoint.dq, snapshot.q_sent, snapshot.state.q)
        return ArmSetpoint(q=allowed.q, dq=allowed.dq)

    def status(self) -> ServoStatus:
        """Return the servo's account of its last tick; built on request, so that the tick need not."""
        snapshot = self._connected()
        now_s = self.clock.now_s()
        self._tell_clips(now_s)
        p50, p999 = self.periods.summary_ms()
        current = self._playback
        buffered_s = 0.0
        if current is not None and current.trajectory_id > self._done_id:
            played_s = snapshot.time_s if current.trajectory_id == snapshot.trajectory_id else 0.0
            buffered_s = max(current.end_s - played_s, 0.0)
        return ServoStatus(
            stamp_s=snapshot.stamp_s,
            mode=snapshot.mode,
            reason=snapshot.reason,
            owner=self._lease.holder(now_s, at_rest=snapshot.mode in (ServoMode.HOLDING, ServoMode.STOPPED)),
            trajectory_id=snapshot.trajectory_id,
            trajectory_time_s=snapshot.time_s,
            buffered_s=buffered_s,
            finished=snapshot.finished,
            q_command=snapshot.q_sent,
            ticks=self.periods.ticks,
            overruns=self.periods.overruns,
            period_ms_p50=p50,
            period_ms_p999=p999,
        )

    # --- Producers' helpers, under the lock -----------------------------------------------------------------------

    def _admit(self, owner: str | None) -> None:
        if self._latch:
            raise StoppedError(self._latch)
        self._lease.beat(owner, self.clock.now_s())

    def _cancel(self, reason: str) -> None:
        self._cancel_reason = reason
        self._target = None
        if self._playback is not None:
            self._done_id = max(self._done_id, self._playback.trajectory_id)

    def _check_start(self, chunk: TrajectoryChunk, snapshot: _Snapshot) -> None:
        # A squeezing gripper's command leads its measurement, so there the command counts, before or after limits.
        commanded = np.abs(chunk.q[0] - snapshot.q_wanted)
        other = np.abs(chunk.q[0] - snapshot.state.q)
        other[N_ARM] = abs(chunk.q[0, N_ARM] - snapshot.q_sent[N_ARM])
        error = np.minimum(commanded, other)
        if error.max() > self.limits.start_error_rad:
            worst = int(error.argmax())
            raise CommandRefusedError(
                f"trajectory {chunk.trajectory_id} starts {error[worst]:.3f} rad from {JOINT_NAMES[worst]} (it is at "
                f"{snapshot.state.q[worst]:.3f} rad, commanded {snapshot.q_wanted[worst]:.3f}); allowed is "
                f"{self.limits.start_error_rad} rad. Plan again from the present pose."
            )

    def _tell_clips(self, now_s: float) -> None:
        if self._clips != self._clips_told and now_s - self._told_s >= _WARN_EVERY_S:
            log.warning("servo: %d setpoints were clipped to the limits.", self._clips - self._clips_told)
            self._clips_told, self._told_s = self._clips, now_s

    # --- The tick -----------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """One cycle: measure, choose the setpoint, limit it, send it. Never blocks and never logs.

        Trajectory time moves on by exactly one control period a call, however late the call is.

        Raises:
            NotConnectedError: before `connect()`.
        """
        self._connected()
        now_s = self.clock.now_s()
        self.periods.record(now_s)
        self._measure()
        q, dq = self._choose(now_s)
        self._command(q, dq)
        self._publish(now_s)

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
        overload = self._overload.update(state.tau)
        blocked = overload or find_blocked(self.limits, self._q_sent, state.q)
        if blocked:
            # Holding the command would go on pushing: once at rest, the arm holds what it measures instead.
            self._give_way = self._give_way or not self._latch
            self._fault(blocked)

    def _fault(self, reason: str) -> None:
        """Latch, as `stop` does: somebody has to look at the arm before it moves again."""
        if not self._latch:
            self._cancel_reason = reason
            self._latch = reason

    def _choose(self, now_s: float) -> tuple[np.ndarray, np.ndarray]:
        if self._rearmed:
            self._rearmed = self._link_lost = False
            self._reason = ""
            self._give_way = True
        if self._done_id > self._trajectory_id:  # cancelled before its first tick
            self._trajectory_id, self._time_s, self._finished = self._done_id, 0.0, False
            self._reason = self._cancel_reason
        current, target = self._playback, self._target
        playing = current is not None and current.trajectory_id > self._done_id and not self._latch
        if playing and current is not None:
            if current.trajectory_id != self._trajectory_id:
                self._begin(current)
            late = self._lateness(now_s)
            self._time_s += CONTROL_PERIOD_S
            if late:
                self._drop(current, late)
            elif self._time_s > current.end_s + 1e-9 and not current.final:
                self._time_s -= CONTROL_PERIOD_S
                self._drop(current, f"trajectory {current.trajectory_id} ran dry at {current.end_s:.3f} s")
            else:
                return self._play(current)
        elif target is not None and not self._latch:
            if now_s - target[1] <= self._send_timeout_s:
                return self._chase(target[0])
            self._target = None
            self._begin_braking("")
        elif self._mode is ServoMode.TRACKING:
            self._begin_braking(self._cancel_reason)
        if self._latch:
            self._reason = self._latch
            if self._playback is not None:
                self._done_id = max(self._done_id, self._playback.trajectory_id)
            self._target = None
        return self._rest()

    def _lateness(self, now_s: float) -> str:
        silent_s = now_s - self._lease.beat_s
        if self._heartbeat_timeout_s is None or silent_s <= self._heartbeat_timeout_s:
            return ""
        return f"no heartbeat from {self._lease.owner!r} for {silent_s:.3f} s (allowed {self._heartbeat_timeout_s} s)"

    def _begin(self, new: playback.Playback) -> None:
        self._trajectory_id, self._time_s = new.trajectory_id, -CONTROL_PERIOD_S
        self._mode, self._reason, self._finished = ServoMode.TRACKING, "", False
        self._join(*new.at(0.0))

    def _join(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Blend from the present command into a motion that begins with `q`, `dq`."""
        gap, gap_rate = self._q - q, self._dq - dq
        self._stop_path, self._since_s = None, 0.0
        self._blend = None
        if np.abs(gap).max() > 1e-9 or np.abs(gap_rate).max() > 1e-9:
            self._blend = Blend(gap, gap_rate, self.limits.ddq_max)

    def _play(self, current: playback.Playback) -> tuple[np.ndarray, np.ndarray]:
        self._time_s = min(self._time_s, current.end_s)  # a blend may outlast the trajectory
        q, dq = self._blended(*current.at(self._time_s))
        if current.final and self._time_s >= current.end_s - 1e-9 and self._blend is None:
            self._finished, self._done_id = True, max(self._done_id, current.trajectory_id)
            if np.abs(dq).max() > _AT_REST_RAD_S:
                self._begin_braking(f"trajectory {current.trajectory_id} ended in motion")
                return self._rest()
            self._mode, self._hold_q = ServoMode.HOLDING, q
            return q, _ZERO
        return q, dq

    def _blended(self, q: np.ndarray, dq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self._blend is None:
            return q, dq
        left, left_rate = self._blend.at(self._since_s)
        if self._since_s >= self._blend.duration_s:
            self._blend = None
        self._since_s += CONTROL_PERIOD_S
        return q + left, dq + left_rate

    def _chase(self, setpoint: ArmSetpoint) -> tuple[np.ndarray, np.ndarray]:
        self._mode, self._reason, self._blend, self._stop_path = ServoMode.TRACKING, "", None, None
        step = self.limits.dq_max * CONTROL_PERIOD_S
        q = np.minimum(np.maximum(setpoint.q, self._q - step), self._q + step)
        return q, (q - self._q) / CONTROL_PERIOD_S

    def _drop(self, current: playback.Playback, reason: str) -> None:
        self._done_id = max(self._done_id, current.trajectory_id)
        self._begin_braking(reason)

    def _begin_braking(self, reason: str) -> None:
        self._reason = reason
        self._mode = ServoMode.BRAKING
        self._blend = None
        self._stop_path, self._since_s = self._brake.plan(self._q, self._dq, self._ddq), 0.0

    def _rest(self) -> tuple[np.ndarray, np.ndarray]:
        """Brake if that is not over, else hold."""
        if self._stop_path is not None:
            self._since_s += CONTROL_PERIOD_S
            q, dq = self._stop_path.at(self._since_s)
            if self._since_s >= self._stop_path.duration_s:
                self._stop_path, self._mode, self._hold_q = None, ServoMode.HOLDING, q
            return q, dq
        if self._give_way:
            self._give_way = False
            self._hold_measured()
        return self._blended(self._hold_q, _ZERO)

    def _hold_measured(self) -> None:
        hold_q = self._hold_q.copy()
        off = np.abs(hold_q - self._state.q) > _GIVE_WAY_RAD
        off[N_ARM] = False  # the gripper goes on holding what it holds
        if off.any():
            hold_q[off] = self._state.q[off]
            self._hold_q = hold_q
            self._join(hold_q, _ZERO)

    def _command(self, q: np.ndarray, dq: np.ndarray) -> None:
        allowed = clip_setpoint(self.limits, q, dq, self._q_sent, self._state.q)
        self._clips += allowed.clipped
        wanted = np.minimum(np.maximum(q, self.limits.q_min), self.limits.q_max)
        wanted[:N_ARM] = allowed.q[:N_ARM]
        self._ddq = (dq - self._dq) / CONTROL_PERIOD_S
        self._q, self._dq = wanted, dq
        if self._link_lost:
            return
        try:
            self._q_sent = self.arm.send(ArmSetpoint(q=allowed.q, dq=allowed.dq)).q
        except HalError as error:
            self._fault(f"the arm takes no commands: {error}")
            self._link_lost = True

    def _publish(self, now_s: float) -> None:
        mode = self._mode
        if self._latch and mode is not ServoMode.BRAKING:
            mode = ServoMode.STOPPED
        reason = self._latch or self._reason
        time_s = max(self._time_s, 0.0)
        self._snapshot = _Snapshot(
            now_s, mode, reason, self._trajectory_id, time_s, self._finished, self._q_sent, self._q, self._state
        )
