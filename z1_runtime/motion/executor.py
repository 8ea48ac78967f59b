"""Execution of planned motions: chunks streamed to the servo ahead of its progress, and checks of that progress."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hal.base import z1
from hal.base.clock import Clock, WallClock
from hal.base.errors import InvalidValueError, Z1Error
from hal.base.messages import ArmState, ServoStatus, TrajectoryChunk
from z1_runtime.types import JointTrajectory

if TYPE_CHECKING:
    from hal.base.arm import ServoedArm

_MARGIN = 2.0  # of the worst lateness lately: the next one may be longer
_FORGET = 0.99  # of the measured lateness remains after each wake-up; half of it after 1.4 s of polls of 20 ms


_QUIET_POLLS = 3  # in a row: a joint that turns back is at rest for one


@dataclass(frozen=True, slots=True, kw_only=True)
class SenderConfig:
    """Timing of the transfer of trajectories to the servo."""

    lead_s: float = 0.3
    """Duration of the motion that waits at the servo [s], which needs up to 0.12 s of it to stop on. Whatever waits,
    after the runtime's end the arm moves no longer than its heartbeat's timeout and a stop."""
    max_lead_s: float = 1.0
    """Maximum of the lead where this process is late [s]."""
    chunk_s: float = 0.1
    """Length of one message [s]."""
    poll_s: float = 0.02
    """Period at which the servo's progress is read [s]."""

    def __post_init__(self) -> None:
        if not 0 < self.poll_s < self.chunk_s < self.lead_s <= self.max_lead_s < float("inf"):
            raise InvalidValueError(
                f"{type(self).__name__} needs 0 < poll_s < chunk_s < lead_s <= max_lead_s; got {self.poll_s}, "
                f"{self.chunk_s}, {self.lead_s}, {self.max_lead_s}."
            )


class AdaptiveLead:
    """The lead, raised by the lateness of wake-ups and requests, and back again as they become punctual."""

    def __init__(self, config: SenderConfig) -> None:
        self._config = config
        self._late_s = 0.0

    @property
    def lead_s(self) -> float:
        """The present lead [s]."""
        return min(self._config.lead_s + _MARGIN * self._late_s, self._config.max_lead_s)

    def record(self, late_s: float) -> None:
        """Record that a chunk could be sent `late_s` [s] later than intended."""
        self._late_s = max(late_s, _FORGET * self._late_s)


class ChunkSender:
    """Streams the chunks of one trajectory, no more of them ahead of the servo than the lead.

    Args:
        arm: whose lease is held.
        chunks: of the trajectory, in order; consumed.
        config: timing.
        lead: shared by the motions of one executor; never raised where the sender is called inline.
    """

    def __init__(
        self, arm: ServoedArm, chunks: deque[TrajectoryChunk], config: SenderConfig, lead: AdaptiveLead
    ) -> None:
        self._arm, self._chunks, self._config, self._lead = arm, chunks, config, lead
        self._trajectory_id = chunks[0].trajectory_id
        self._sent_s = 0.0

    def send_due(self, status: ServoStatus) -> None:
        """Send what is due at the servo's progress.

        Raises:
            HalError: the servo rejects a chunk.
        """
        played_s = status.trajectory_time_s if status.trajectory_id == self._trajectory_id else 0.0
        while self._chunks and self._sent_s - played_s < self._lead.lead_s:
            chunk = self._chunks.popleft()
            self._arm.stream(chunk)
            self._sent_s = float(chunk.t_s[-1])

    def run(self, clock: Clock, is_stopped: Callable[[], bool] = lambda: False) -> None:
        """Send all chunks, and return after the last one, or when the motion is over or `is_stopped`."""
        due_s = clock.now_s()
        while not is_stopped():
            status = self._arm.status()
            if status.trajectory_id >= self._trajectory_id and (status.finished or status.reason):
                return  # played, or dropped: the executor reports it
            self.send_due(status)
            if not self._chunks:
                return
            now_s = clock.now_s()
            self._lead.record(now_s - due_s)
            due_s = now_s + self._config.poll_s
            clock.sleep_until(due_s)


class MotionError(Z1Error, RuntimeError):
    """A motion that was begun and not finished; the arm has braked and holds."""

    default_code = "motion"


@dataclass(frozen=True, slots=True, kw_only=True)
class ExecutorConfig(SenderConfig):
    """Timing of motions and of their transfer to the servo."""

    stall_timeout_s: float = 1.0
    """Maximum time without progress of a motion before it counts as lost [s]."""
    settle_dq: float = 0.02
    """Joint speed that counts as rest [rad/s]."""
    settle_timeout_s: float = 3.0
    """Maximum time that a motion takes to come to rest after its end [s]."""

    def __post_init__(self) -> None:
        SenderConfig.__post_init__(self)
        for name in ("stall_timeout_s", "settle_dq", "settle_timeout_s"):
            if not 0 < getattr(self, name) < np.inf:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be positive and finite.")


Watcher = Callable[[ArmState, ServoStatus], None]


class Executor:
    """Plays trajectories on a `ServoedArm` whose lease is held.

    On the wall clock a thread of its own sends the chunks; in lock-step, where time moves only while the caller
    sleeps, they are sent inline, and the same calls give the same bytes.
    """

    def __init__(self, arm: ServoedArm, clock: Clock, config: ExecutorConfig | None = None) -> None:
        self._arm = arm
        self._clock = clock
        self._config = config or ExecutorConfig()
        self._lead = AdaptiveLead(self._config)
        self.watchers: list[Watcher] = []
        """Called with the arm's state at every poll, for logs; must return at once."""

    def execute(self, trajectory: JointTrajectory) -> None:
        """Play `trajectory` to its end; return when the servo has sent its last point.

        Raises:
            InvalidMessageError: the trajectory holds values that are not finite; nothing moves.
            CommandRejectedError: the servo rejects it (stopped, wrong start, limits, lease).
            MotionError: it was dropped while it ran, with the servo's reason, or makes no more progress.
        """
        trajectory_id = self._arm.status().trajectory_id + 1
        chunks = _chunks(trajectory, trajectory_id, self._config.chunk_s)
        sender = ChunkSender(self._arm, chunks, self._config, self._lead)
        if not isinstance(self._clock, WallClock):
            self._await_end(trajectory, trajectory_id, sender.send_due)
            return
        from z1_runtime.motion.sender_thread import SenderThread

        with SenderThread(sender.run, self._clock) as thread:
            self._await_end(trajectory, trajectory_id, lambda _: thread.raise_error())

    def _await_end(
        self, trajectory: JointTrajectory, trajectory_id: int, send_due: Callable[[ServoStatus], None]
    ) -> None:
        """Wait for the end of a motion; call `send_due` at every poll."""
        played_s = 0.0
        moved_s = self._clock.now_s()
        while True:
            status = self._poll()
            # Until the servo has the first chunk, its status is that of the motion before
            ours = status.trajectory_id == trajectory_id
            if ours and status.finished:
                return
            if ours and status.reason:
                raise MotionError(
                    f"the motion was dropped {status.trajectory_time_s:.2f} s into {trajectory.duration_s:.2f} s: "
                    f"{status.reason}; the arm holds.",
                    code="dropped",
                )
            if ours and status.trajectory_time_s > played_s:
                played_s, moved_s = status.trajectory_time_s, self._clock.now_s()
            elif self._clock.now_s() - moved_s > self._config.stall_timeout_s:
                raise MotionError(_describe_stall(status, trajectory_id, played_s), code="stalled")
            send_due(status)
            # In lock-step, time moves only while a caller sleeps
            self._clock.sleep_until(self._clock.now_s() + self._config.poll_s)

    def settle(self) -> ArmState:
        """Wait until no joint moves; return that state.

        Raises:
            MotionError: it does not come to rest in time.
        """
        deadline_s = self._clock.now_s() + self._config.settle_timeout_s
        n_quiet = 0
        while True:
            self._clock.sleep_until(self._clock.now_s() + self._config.poll_s)
            self._poll()
            state = self._arm.read_state()
            n_quiet = n_quiet + 1 if np.abs(state.dq).max() < self._config.settle_dq else 0
            if n_quiet >= _QUIET_POLLS:
                return state
            if self._clock.now_s() > deadline_s:
                joint = int(np.abs(state.dq).argmax())
                raise MotionError(
                    f"{z1.JOINT_NAMES[joint]} still moves at {state.dq[joint]:.3f} rad/s, "
                    f"{self._config.settle_timeout_s} s after the motion; rest is {self._config.settle_dq} rad/s.",
                    code="not_settled",
                )

    def _poll(self) -> ServoStatus:
        status = self._arm.status()
        if self.watchers:
            state = self._arm.read_state()
            for watch in self.watchers:
                watch(state, status)
        return status


def _chunks(trajectory: JointTrajectory, trajectory_id: int, length_s: float) -> deque[TrajectoryChunk]:
    """Return all of `trajectory`, checked before any of it moves the arm."""
    n = len(trajectory.t_s)
    return deque(
        TrajectoryChunk(
            trajectory_id=trajectory_id,
            t_s=trajectory.t_s[part],
            q=trajectory.q[part],
            dq=trajectory.dq[part],
            final=part.stop == n,
        )
        for part in trajectory.split(length_s)
    )


def _describe_stall(status: ServoStatus, trajectory_id: int, played_s: float) -> str:
    where = f"after {played_s:.2f} s of it" if played_s > 0.0 else "before its start"
    now = f"the servo is {status.mode.value}, at trajectory {status.trajectory_id}"
    reason = f" ({status.reason})" if status.reason else ""
    return (
        f"motion {trajectory_id} makes no progress {where}: {now}{reason}. "
        "The HAL was restarted, its ticks have ended, or another client has taken the arm; see its log."
    )
