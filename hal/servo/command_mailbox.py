"""Command mailbox between the producers' threads and the tick: lease, trajectory queue, single setpoint, latched stop.

Any thread calls the methods, which take `_lock` to keep the producers apart. The tick takes no lock: it reads and
replaces whole attributes that hold immutable objects (`trajectory`, `target`, `latch`), which Python does atomically,
and each counter has one writer (`cancelled_id` the producers, `played_id` the tick). A stop therefore takes effect at
the next tick whatever else is running.
"""

from __future__ import annotations

from threading import Lock
from typing import NamedTuple

import numpy as np

from hal.base.errors import CommandRejectedError, GuardError, StoppedError
from hal.base.messages import ArmSetpoint, ArmState, ServoMode, TrajectoryChunk
from hal.base.z1 import JOINT_NAMES, N_ARM
from hal.servo.guard import Guard
from hal.servo.lease import Lease
from hal.servo.limits import ServoLimits
from hal.servo.trajectory_buffer import TrajectoryBuffer, extend_buffer, start_buffer

_CHECK_EVERY_S = 0.01
"""Time between two postures that the guard checks [s]: at full speed a joint turns 0.03 rad in it."""


class Snapshot(NamedTuple):
    """The result of a tick for all other threads; replaced as a whole."""

    stamp_s: float
    mode: ServoMode
    reason: str
    trajectory_id: int
    trajectory_time_s: float
    finished: bool
    q_sent: np.ndarray
    """(7,) setpoint sent, after all limits [rad]."""
    q_desired: np.ndarray
    """(7,) the same with the gripper before its squeeze limit [rad]."""
    state: ArmState

    @property
    def at_rest(self) -> bool:
        """True when nothing moves."""
        return self.mode in (ServoMode.HOLDING, ServoMode.STOPPED)


class Target(NamedTuple):
    """A single setpoint to track."""

    setpoint: ArmSetpoint
    stamp_s: float


class CommandMailbox:
    """The producers' side of a servo.

    Args:
        limits: of trajectories.
        lease_timeout_s: see `hal.servo.lease.Lease`.
        guard: check of trajectories and setpoints; None = anywhere inside the joint limits.
    """

    def __init__(self, limits: ServoLimits, lease_timeout_s: float | None, guard: Guard | None = None) -> None:
        self._limits = limits
        self.guard = guard
        """May be set as long as nothing moves."""
        self._lock = Lock()
        self.lease = Lease(lease_timeout_s)
        self.reset()

    def reset(self) -> None:
        """Clear everything: lease, motion and latched stop."""
        with self._lock:
            self.trajectory: TrajectoryBuffer | None = None
            """The newest trajectory, over or not."""
            self.target: Target | None = None
            self.latch = ""
            """Reason of the latched stop; empty when not stopped."""
            self.cancelled_id = 0
            """Trajectories up to this one were cancelled by a producer."""
            self.played_id = 0
            """Trajectories up to this one were ended by the tick."""
            self.cancel_reason = ""
            """Reason of the last cancellation by a producer."""
            self.blocked_trajectories: dict[int, str] = {}
            """A trajectory of which a later chunk violates the guard, and the text; replaced, not changed."""
            self.rearm_pending = False
            """Set by `rearm`, cleared by the tick."""
            self.out_of_limits_count = 0
            """Number of single setpoints outside the joint limits."""
            self.lease.clear()

    @property
    def finished_id(self) -> int:
        """Trajectories up to this one are over."""
        return max(self.cancelled_id, self.played_id)

    @property
    def active_trajectory(self) -> TrajectoryBuffer | None:
        """The trajectory to play; None when there is none."""
        newest = self.trajectory
        return newest if newest is not None and newest.trajectory_id > self.finished_id else None

    def finish(self, trajectory: TrajectoryBuffer | None) -> None:
        """Mark `trajectory`, and all before it, as over; for the tick."""
        if trajectory is not None:
            self.played_id = trajectory.trajectory_id

    def claim(self, owner: str, now_s: float, *, at_rest: bool) -> None:
        """Claim the lease (errors as `Lease.claim`); while the stop is latched, also from another client."""
        with self._lock:
            if self.latch:
                self.lease.clear()
            self.lease.claim(owner, now_s, at_rest=at_rest)

    def release(self, owner: str | None) -> None:
        """Release the lease and cancel the motion, if `owner` (None = any) owns it."""
        with self._lock:
            if self.lease.owner and owner in (None, self.lease.owner):
                self._cancel(f"{self.lease.owner!r} released the arm in motion")
                self.lease.clear()

    def renew(self, owner: str | None, now_s: float) -> None:
        """Record a heartbeat (errors as `Lease.renew`)."""
        with self._lock:
            self.lease.renew(owner, now_s)

    def stop(self, reason: str) -> None:
        """Latch the stop and drop the queue; the first reason stays."""
        with self._lock:
            self.latch = self.latch or reason
            self._cancel(reason)

    def rearm(self, owner: str | None, now_s: float) -> None:
        """Clear a latched stop and free the lease; `owner` (None = the operator) must own it, as for a command."""
        with self._lock:
            if owner is not None:
                self.lease.renew(owner, now_s)
            if self.latch:
                self._drop()  # a command may have been accepted while the tick found a fault
                self.latch = ""
                self.lease.clear()
                self.rearm_pending = True

    def stream(self, chunk: TrajectoryChunk, owner: str | None, now_s: float, snapshot: Snapshot) -> None:
        """Queue `chunk` (errors as `hal.servo.servo.Servo.stream`)."""
        with self._lock:
            self._check_authority(owner, now_s)
            active = self.active_trajectory
            if active is not None and chunk.trajectory_id == active.trajectory_id:
                self._extend(active, chunk, snapshot)
                return
            newest = max(self.finished_id, self.trajectory.trajectory_id if self.trajectory else 0)
            if chunk.trajectory_id <= newest:
                raise CommandRejectedError(
                    f"servo: trajectory {chunk.trajectory_id} is over ({snapshot.reason or 'played or replaced'}). "
                    f"Start a new one, number {newest + 1} or above.",
                    code="stale_trajectory",
                )
            self._check_start(chunk, snapshot)
            new = start_buffer(chunk, self._limits)
            self._check_guard(new, chunk, snapshot)
            self.target, self.trajectory = None, new  # last, after all checks: the tick may play it at once

    def send(self, setpoint: ArmSetpoint, owner: str | None, now_s: float, snapshot: Snapshot) -> None:
        """Set `setpoint` as the target (errors as `hal.servo.servo.Servo.send`)."""
        with self._lock:
            self._check_authority(owner, now_s)
            active = self.active_trajectory
            if active is not None:
                raise CommandRejectedError(
                    f"servo: trajectory {active.trajectory_id} is playing. Wait for its end, or call release().",
                    code="trajectory_active",
                )
            if self.guard and (violation := self.guard.find_violation(setpoint.q[None], snapshot.q_sent)):
                raise GuardError(
                    f"guard: the setpoint {violation.text}. Command a pose inside the workspace.", code=violation.code
                )
            self.target = Target(setpoint, now_s)
            # Counted for the log, not rejected: the tick clips it.
            self.out_of_limits_count += bool(
                ((setpoint.q < self._limits.q_min) | (setpoint.q > self._limits.q_max)).any()
            )

    def _extend(self, active: TrajectoryBuffer, chunk: TrajectoryChunk, snapshot: Snapshot) -> None:
        played_s = snapshot.trajectory_time_s if snapshot.trajectory_id == active.trajectory_id else 0.0
        extended = extend_buffer(active, chunk, played_s, self._limits)
        try:
            self._check_guard(extended, chunk, snapshot)
        except GuardError as error:
            # The rest will not be queued: the tick brakes on the part of the path that is buffered.
            self.blocked_trajectories = {chunk.trajectory_id: str(error)}
            raise
        self.trajectory = extended

    def _check_authority(self, owner: str | None, now_s: float) -> None:
        """Reject a command while the stop is latched or from another client; it counts as a heartbeat."""
        if self.latch:
            raise StoppedError(self.latch)
        self.lease.renew(owner, now_s)

    def _cancel(self, reason: str) -> None:
        self.cancel_reason = reason
        self._drop()

    def _drop(self) -> None:
        self.target = None
        if self.trajectory is not None:
            self.cancelled_id = self.trajectory.trajectory_id

    def _check_guard(self, new: TrajectoryBuffer, chunk: TrajectoryChunk, snapshot: Snapshot) -> None:
        if self.guard is None:
            return
        start_s = float(chunk.t_s[0])
        violation = self.guard.find_violation(new.sample_positions(start_s, _CHECK_EVERY_S), snapshot.q_sent)
        if violation is not None:
            t_s = start_s + violation.index * _CHECK_EVERY_S
            raise GuardError(
                f"guard: trajectory {chunk.trajectory_id} {violation.text} at t = {t_s:.2f} s. Plan inside the "
                f"workspace.",
                code=violation.code,
            )

    def _check_start(self, chunk: TrajectoryChunk, snapshot: Snapshot) -> None:
        # A squeezing gripper's command leads its measurement, so there the command counts, before or after limits.
        commanded = np.abs(chunk.q[0] - snapshot.q_desired)
        other = np.abs(chunk.q[0] - snapshot.state.q)
        other[N_ARM] = abs(chunk.q[0, N_ARM] - snapshot.q_sent[N_ARM])
        error = np.minimum(commanded, other)
        if error.max() > self._limits.start_error_rad:
            worst = int(error.argmax())
            raise CommandRejectedError(
                f"servo: trajectory {chunk.trajectory_id} starts {error[worst]:.3f} rad from {JOINT_NAMES[worst]} "
                f"(measured {snapshot.state.q[worst]:.3f} rad, commanded {snapshot.q_desired[worst]:.3f} rad, allowed "
                f"{self._limits.start_error_rad} rad). Plan again from the present pose.",
                code="start_jump",
            )
