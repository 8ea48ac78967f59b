"""Status and health of the servo, built on request, and the log lines that the tick must not write."""

from __future__ import annotations

import logging

import numpy as np

from hal.base.messages import ServoHealth, ServoStatus
from hal.servo.command_mailbox import CommandMailbox, Snapshot
from hal.servo.periods import PeriodStatistics

log = logging.getLogger(__name__)

_WARNING_PERIOD_S = 1.0  # a clipped stream clips at 500 Hz: one line a second is enough to read


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
    snapshot: Snapshot, mailbox: CommandMailbox, periods: PeriodStatistics, real_time: tuple[str, ...], now_s: float
) -> ServoHealth:
    """Return the health from the same inputs, for a thread that was granted `real_time`."""
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
    )


class StatusLogger:
    """Logger of latched stops, once each, and of clipped setpoints, once a second; run by each status request."""

    def __init__(self) -> None:
        self._latch = ""
        self._clipped_count = 0
        self._logged_s = -np.inf  # the first clipped setpoint is logged at once

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
        if clipped_count != self._clipped_count and now_s - self._logged_s >= _WARNING_PERIOD_S:
            log.warning("servo: %d setpoints were clipped to the limits.", clipped_count - self._clipped_count)
            self._clipped_count, self._logged_s = clipped_count, now_s
