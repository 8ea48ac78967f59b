"""Status and health of the servo, its tick periods, and the log lines that the tick must not write."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hal.base.messages import ServoHealth, ServoStatus
from hal.base.z1 import CONTROL_PERIOD_S
from hal.servo.command_mailbox import CommandMailbox, Snapshot

if TYPE_CHECKING:
    from hal.base.arm import CommandLatency

_SUMMARY_TICKS = 500  # one second at 500 Hz, the rate at which health is published
_OVERRUN_PERIODS = 1.5  # a tick later than half a period has moved all later deadlines (`servo_thread`)


class PeriodSummary(NamedTuple):
    """Rate and percentiles of the recorded periods, each a period that occurred; zeros while unmeasured."""

    rate_hz: float = 0.0
    """Ticks per second."""
    p50_ms: float = 0.0
    p99_ms: float = 0.0
    p999_ms: float = 0.0
    max_ms: float = 0.0


class PeriodStatistics:
    """A ring of the last measured periods; recording allocates nothing, percentiles are computed on request.

    Args:
        capacity: periods kept; the default is one minute.
    """

    def __init__(self, capacity: int = 30_000) -> None:
        self._ring_s = np.zeros(capacity)
        self._filled = 0
        self._next = 0
        self._last_s: float | None = None
        self._summary = PeriodSummary()
        self._due_ticks = 0
        self.ticks = 0
        """Ticks since the start."""
        self.overruns = 0
        """Ticks that began more than half a period late, relative to the tick before."""
        self._measuring = False

    def set_measuring(self, on: bool) -> None:
        """Start or stop keeping periods: for a wall-clock thread that begins or ends its ticks.

        In lock-step a period says nothing about the machine. The time between two threads is no period.
        """
        self._measuring, self._last_s = on, None

    def record(self, now_s: float) -> None:
        """Record a tick that began at `now_s` [s]."""
        self.ticks += 1
        last, self._last_s = self._last_s, now_s
        if last is None:
            return
        period_s = now_s - last
        if period_s > _OVERRUN_PERIODS * CONTROL_PERIOD_S:
            self.overruns += 1
        if self._measuring:
            self._ring_s[self._next] = period_s
            self._next = (self._next + 1) % len(self._ring_s)
            self._filled = min(self._filled + 1, len(self._ring_s))

    def summary(self) -> PeriodSummary:
        """Return rate and percentiles of the recorded periods.

        Partitioning the ring takes the interpreter from the tick, so the result is cached for `_SUMMARY_TICKS`;
        `np.percentile` would take 57 ms for its first call.
        """
        filled = self._filled  # read once: the tick may fill another place at any time
        if filled and self.ticks >= self._due_ticks:
            self._due_ticks = self.ticks + _SUMMARY_TICKS
            ring_s = self._ring_s[:filled]
            ranks = [round(quantile * (filled - 1)) for quantile in (0.5, 0.99, 0.999, 1.0)]
            parted_ms = 1e3 * np.partition(ring_s, ranks)[ranks]  # nearest rank
            self._summary = PeriodSummary(filled / float(ring_s.sum()), *parted_ms.tolist())
        return self._summary


log = logging.getLogger(__name__)

_EPISODE_GAP_S = 1.0  # without a clipped setpoint for so long, the next one begins another episode


def make_status(snapshot: Snapshot, mailbox: CommandMailbox, periods: PeriodStatistics, now_s: float) -> ServoStatus:
    """Return the status from the last tick's `snapshot`, the `mailbox` and the measured `periods`."""
    summary = periods.summary()
    active = mailbox.active_trajectory
    buffered_s = 0.0
    if active is not None:
        played_s = snapshot.trajectory_time_s if active.trajectory_id == snapshot.trajectory_id else 0.0
        buffered_s = max(active.end_s - played_s, 0.0)
    return ServoStatus(
        stamp_s=snapshot.stamp_s,
        mode=snapshot.mode,
        reason=snapshot.reason,
        owner=mailbox.lease.current_owner(now_s, at_rest=snapshot.at_rest),
        trajectory_id=snapshot.trajectory_id,
        trajectory_time_s=snapshot.trajectory_time_s,
        buffered_s=buffered_s,
        finished=snapshot.finished,
        q_command=snapshot.q_sent,
        ticks=periods.ticks,
        overruns=periods.overruns,
        period_ms_p50=summary.p50_ms,
        period_ms_p999=summary.p999_ms,
    )


def make_health(
    snapshot: Snapshot,
    mailbox: CommandMailbox,
    periods: PeriodStatistics,
    now_s: float,
    *,
    real_time: tuple[str, ...],
    latency: CommandLatency,
) -> ServoHealth:
    """Return the health from the same inputs, for a thread that was granted `real_time` and an arm with `latency`."""
    summary = periods.summary()
    owner = mailbox.lease.current_owner(now_s, at_rest=snapshot.at_rest)
    return ServoHealth(
        stamp_s=now_s,
        mode=snapshot.mode,
        faults=(mailbox.latch,) if mailbox.latch else snapshot.state.faults,
        rate_hz=summary.rate_hz,
        period_ms_p50=summary.p50_ms,
        period_ms_p99=summary.p99_ms,
        period_ms_p999=summary.p999_ms,
        period_ms_max=summary.max_ms,
        ticks=periods.ticks,
        overruns=periods.overruns,
        owner=owner,
        # Another thread may record a heartbeat after `now_s` was read.
        command_age_s=max(now_s - mailbox.lease.last_heartbeat_s, 0.0) if owner else 0.0,
        real_time=real_time,
        command_latency_ms_p50=latency.p50_ms,
        command_latency_ms_p99=latency.p99_ms,
        command_latency_ms_max=latency.max_ms,
    )


class StatusLogger:
    """Logger of latched stops and of episodes of clipped setpoints, once each; run by each status request."""

    def __init__(self) -> None:
        self._latch = ""
        self._clipped_count = 0
        self._clipped_s = -np.inf  # of the last change of the count

    def log_changes(self, latch: str, clipped_count: int, now_s: float) -> None:
        """Log the changes since the last call.

        Args:
            latch: reason of the latched stop; empty when the servo is not stopped.
            clipped_count: setpoints that the limits have changed so far.
            now_s: time of the call [s].
        """
        if latch != self._latch:
            self._latch = latch
            log.info("servo: %s", f"stopped: {latch}" if latch else "re-armed")
        if clipped_count != self._clipped_count:
            if now_s - self._clipped_s > _EPISODE_GAP_S:
                log.warning(
                    "servo: the arm does not go where it is commanded: setpoints are beyond its joint limits or its "
                    "speed, or it lags behind them, and it moves to the nearest that is allowed. Check the targets of "
                    "the client. The next line like this is about another episode."
                )
            self._clipped_count, self._clipped_s = clipped_count, now_s
