"""What the servo says of itself: its status on request, and the log lines that its tick must not write."""

from __future__ import annotations

import logging

import numpy as np

from hal.base.messages import ServoHealth, ServoStatus
from hal.servo.command_mailbox import Orders, Snapshot
from hal.servo.periods import PeriodStatistics

log = logging.getLogger(__name__)

_WARN_EVERY_S = 1.0


def make_status(snapshot: Snapshot, orders: Orders, periods: PeriodStatistics, now_s: float) -> ServoStatus:
    """Return the status that the last tick's `snapshot`, the `orders` and the measured `periods` amount to."""
    summary = periods.summary()
    current = orders.current
    buffered_s = 0.0
    if current is not None:
        played_s = snapshot.time_s if current.trajectory_id == snapshot.trajectory_id else 0.0
        buffered_s = max(current.end_s - played_s, 0.0)
    return ServoStatus(
        stamp_s=snapshot.stamp_s,
        mode=snapshot.mode,
        reason=snapshot.reason,
        owner=orders.lease.holder(now_s, at_rest=snapshot.at_rest),
        trajectory_id=snapshot.trajectory_id,
        trajectory_time_s=snapshot.time_s,
        buffered_s=buffered_s,
        finished=snapshot.finished,
        q_command=snapshot.q_sent,
        ticks=periods.ticks,
        overruns=periods.overruns,
        period_ms_p50=summary.p50_ms,
        period_ms_p999=summary.p999_ms,
    )


def make_health(
    snapshot: Snapshot, orders: Orders, periods: PeriodStatistics, real_time: tuple[str, ...], now_s: float
) -> ServoHealth:
    """Return the health that the same amount to, of a thread that was granted `real_time`."""
    summary = periods.summary()
    owner = orders.lease.holder(now_s, at_rest=snapshot.at_rest)
    return ServoHealth(
        stamp_s=now_s,
        mode=snapshot.mode,
        faults=(orders.latch,) if orders.latch else snapshot.state.faults,
        rate_hz=summary.rate_hz,
        period_ms_p50=summary.p50_ms,
        period_ms_p99=summary.p99_ms,
        period_ms_p999=summary.p999_ms,
        period_ms_max=summary.max_ms,
        ticks=periods.ticks,
        overruns=periods.overruns,
        owner=owner,
        command_age_s=max(now_s - orders.lease.beat_s, 0.0) if owner else 0.0,
        real_time=real_time,
    )


class Teller:
    """Logs each latched stop once, and clipped setpoints once a second; called by whoever asks for the status."""

    def __init__(self) -> None:
        self._latch = ""
        self._clips = 0
        self._told_s = -np.inf

    def tell(self, latch: str, clips: int, now_s: float) -> None:
        """Log what is new: `latch`, why the servo is stopped, and `clips`, how many setpoints were clipped so far."""
        if latch != self._latch:
            self._latch = latch
            log.info("servo: %s", f"stopped: {latch}" if latch else "re-armed")
        if clips != self._clips and now_s - self._told_s >= _WARN_EVERY_S:
            log.warning("servo: %d setpoints were clipped to the limits.", clips - self._clips)
            self._clips, self._told_s = clips, now_s
