"""Sender of one trajectory: chunks streamed to the servo ahead of its progress, by a lead that adapts to lateness."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from hal.base.arm import ServoedArm
from hal.base.background_loop import BackgroundLoop
from hal.base.clock import Clock
from hal.base.errors import InvalidValueError, Z1Error
from hal.base.messages import ServoStatus, TrajectoryChunk

_MARGIN = 2.0  # of the worst lateness lately: the next one may be longer
_FORGET = 0.99  # of the measured lateness remains after each wake-up; half of it after 1.4 s of polls of 20 ms


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


class SenderThread(BackgroundLoop):
    """A thread of its own for a sender: whatever the caller does meanwhile, such as logging, delays no chunk."""

    def __init__(self, sender: ChunkSender, clock: Clock) -> None:
        super().__init__("chunk sender")
        self._sender, self._clock = sender, clock
        self.error: Z1Error | None = None
        """The error that ended the sending; the executor raises it."""

    def _run(self) -> None:
        try:
            self._sender.run(self._clock, self._stop_requested.is_set)
        except Z1Error as error:
            self.error = error

    def raise_error(self) -> None:
        """Raise the error that ended the sending, if there is one."""
        if self.error is not None:
            raise self.error
