"""What producers ask of the servo: the lease, the queue of trajectory pieces, single setpoints, the latched stop.

Any thread calls the methods, which take `_lock` to keep the producers apart. The tick takes no lock: it reads and
replaces whole attributes holding immutable objects (`trajectory`, `target`, `latch`), which Python does atomically, and
what is counted up has one writer each (`cancelled_id` the producers, `played_id` the tick). A stop therefore takes
effect at the next tick whatever else is going on.
"""

from __future__ import annotations

from threading import Lock
from typing import NamedTuple

import numpy as np

from hal.base.errors import CommandRejectedError, GuardError, StoppedError
from hal.base.messages import ArmSetpoint, ArmState, ServoMode, TrajectoryChunk
from hal.base.z1 import JOINT_NAMES, N_ARM
from hal.servo import trajectory_buffer
from hal.servo.guard import Guard
from hal.servo.lease import Lease
from hal.servo.limits import ServoLimits

_CHECK_EVERY_S = 0.01
"""Time between two postures that the guard looks at [s]."""


class Snapshot(NamedTuple):
    """What the tick tells everybody; replaced as a whole."""

    stamp_s: float
    mode: ServoMode
    reason: str
    trajectory_id: int
    trajectory_time_s: float
    finished: bool
    q_sent: np.ndarray
    q_desired: np.ndarray
    state: ArmState

    @property
    def at_rest(self) -> bool:
        """Whether nothing moves."""
        return self.mode in (ServoMode.HOLDING, ServoMode.STOPPED)


class Target(NamedTuple):
    """A single setpoint to move towards."""

    setpoint: ArmSetpoint
    stamp_s: float


class CommandMailbox:
    """The producers' side of a servo.

    Args:
        limits: what trajectories are checked against.
        lease_timeout_s: see `hal.servo.lease.Lease`.
        guard: keeps trajectories and setpoints where the arm may be; None = anywhere inside the joint limits.
    """

    def __init__(self, limits: ServoLimits, lease_timeout_s: float | None, guard: Guard | None = None) -> None:
        self._limits = limits
        self.guard = guard
        """May be set as long as nothing moves."""
        self._lock = Lock()
        self.lease = Lease(lease_timeout_s)
        self.reset()

    def reset(self) -> None:
        """Forget everything: no lease, no motion, no latched stop."""
        with self._lock:
            self.trajectory: trajectory_buffer.TrajectoryBuffer | None = None
            self.target: Target | None = None
            self.latch = ""
            """Why the servo is stopped; empty when it is not."""
            self.cancelled_id = 0
            """Trajectories up to this one are over because a producer said so."""
            self.played_id = 0
            """Trajectories up to this one are over because the tick said so."""
            self.cancel_reason = ""
            """Why the last one was cut short by a producer."""
            self.blocked_trajectories: dict[int, str] = {}
            """The trajectory a later piece of which leads where the arm may not be, and why; replaced, not changed."""
            self.rearmed = False
            """Set by `rearm`, taken by the tick."""
            self.out_of_limits_count = 0
            """How many single setpoints lay outside the joint limits."""
            self.lease.clear()

    @property
    def finished_id(self) -> int:
        """Trajectories up to this one are over."""
        return max(self.cancelled_id, self.played_id)

    @property
    def active_trajectory(self) -> trajectory_buffer.TrajectoryBuffer | None:
        """The trajectory that is to be played; None when none is."""
        newest = self.trajectory
        return newest if newest is not None and newest.trajectory_id > self.finished_id else None

    def finish(self, trajectory: trajectory_buffer.TrajectoryBuffer | None) -> None:
        """Call `trajectory` over, and all before it; for the tick."""
        if trajectory is not None:
            self.played_id = trajectory.trajectory_id

    def claim(self, owner: str, now_s: float, *, at_rest: bool) -> None:
        """Take the lease (errors as `Lease.claim`)."""
        with self._lock:
            self.lease.claim(owner, now_s, at_rest=at_rest)

    def release(self, owner: str | None) -> None:
        """Give the lease back, if `owner` (None = whoever) holds it, and cancel the motion."""
        with self._lock:
            if self.lease.owner and owner in (None, self.lease.owner):
                self._cancel(f"{self.lease.owner!r} released the arm in motion")
                self.lease.clear()

    def renew(self, owner: str | None, now_s: float) -> None:
        """Note that the owner lives (errors as `Lease.renew`)."""
        with self._lock:
            self.lease.renew(owner, now_s)

    def stop(self, reason: str) -> None:
        """Latch the stop and drop what is queued."""
        with self._lock:
            self.latch = self.latch or reason
            self._cancel(reason)

    def rearm(self) -> None:
        """Lift a latched stop and free the lease."""
        with self._lock:
            if self.latch:
                self._drop()  # what was taken while the tick found a fault
                self.latch = ""
                self.lease.clear()
                self.rearmed = True

    def stream(self, chunk: TrajectoryChunk, owner: str | None, now_s: float, snapshot: Snapshot) -> None:
        """Queue `chunk` (errors as `hal.servo.servo.Servo.stream`)."""
        with self._lock:
            self._admit(owner, now_s)
            running = self.active_trajectory
            if running is not None and chunk.trajectory_id == running.trajectory_id:
                played_s = snapshot.trajectory_time_s if snapshot.trajectory_id == running.trajectory_id else 0.0
                extended = trajectory_buffer.extend(running, chunk, played_s, self._limits)
                try:
                    self._check_space(extended, chunk, snapshot)
                except GuardError as error:
                    # The rest will not come: what is buffered is for braking on.
                    self.blocked_trajectories = {chunk.trajectory_id: str(error)}
                    raise
                self.trajectory = extended
                return
            newest = max(self.finished_id, self.trajectory.trajectory_id if self.trajectory else 0)
            if chunk.trajectory_id <= newest:
                raise CommandRejectedError(
                    f"trajectory {chunk.trajectory_id} is over ({snapshot.reason or 'played or replaced'}); "
                    f"the next one is {newest + 1} or more."
                )
            self._check_start(chunk, snapshot)
            begun = trajectory_buffer.begin(chunk, self._limits)
            self._check_space(begun, chunk, snapshot)
            self.target, self.trajectory = None, begun

    def send(self, setpoint: ArmSetpoint, owner: str | None, now_s: float, snapshot: Snapshot) -> None:
        """Make `setpoint` the target (errors as `hal.servo.servo.Servo.send`)."""
        with self._lock:
            self._admit(owner, now_s)
            running = self.active_trajectory
            if running is not None:
                raise CommandRejectedError(
                    f"trajectory {running.trajectory_id} is playing; let it end or release() it."
                )
            if self.guard and (refusal := self.guard.refusal(setpoint.q[None], snapshot.q_sent)):
                raise GuardError(f"the setpoint {refusal[1]}.")
            self.target = Target(setpoint, now_s)
            self.out_of_limits_count += bool(((setpoint.q < self._limits.q_min) | (setpoint.q > self._limits.q_max)).any())

    def _admit(self, owner: str | None, now_s: float) -> None:
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

    def _check_space(self, new: trajectory_buffer.TrajectoryBuffer, chunk: TrajectoryChunk, snapshot: Snapshot) -> None:
        if self.guard is None:
            return
        start_s = float(chunk.t_s[0])
        refusal = self.guard.refusal(new.sample_positions(start_s, _CHECK_EVERY_S), snapshot.q_sent)
        if refusal is not None:
            index, what = refusal
            raise GuardError(f"trajectory {chunk.trajectory_id} {what} (t = {start_s + index * _CHECK_EVERY_S:.2f} s).")

    def _check_start(self, chunk: TrajectoryChunk, snapshot: Snapshot) -> None:
        # A squeezing gripper's command leads its measurement, so there the command counts, before or after limits.
        commanded = np.abs(chunk.q[0] - snapshot.q_desired)
        other = np.abs(chunk.q[0] - snapshot.state.q)
        other[N_ARM] = abs(chunk.q[0, N_ARM] - snapshot.q_sent[N_ARM])
        error = np.minimum(commanded, other)
        if error.max() > self._limits.start_error_rad:
            worst = int(error.argmax())
            raise CommandRejectedError(
                f"trajectory {chunk.trajectory_id} starts {error[worst]:.3f} rad from {JOINT_NAMES[worst]} (it is at "
                f"{snapshot.state.q[worst]:.3f} rad, commanded {snapshot.q_desired[worst]:.3f}); allowed is "
                f"{self._limits.start_error_rad} rad. Plan again from the present pose."
            )
