"""Health of a HAL process, for clients that command nothing."""

from __future__ import annotations

import queue

import zenoh

from hal.base.clock import Clock
from hal.base.errors import HalTimeoutError
from hal.base.messages import ServoHealth
from hal.bus import keys
from hal.bus.codec import decode
from hal.bus.link import BusLink
from hal.bus.service import Listener, as_bytes
from hal.bus.session import BusConfig


def wait_for_health(config: BusConfig, clock: Clock, timeout_s: float = 3.0) -> ServoHealth:
    """Return the next health that the HAL process publishes, within about a second.

    Raises:
        HalTimeoutError: no HAL process answers, or it publishes no health (`no_health`).
        InvalidMessageError: the published message is malformed.
    """
    messages: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    link = BusLink(config, clock, "the HAL's health")

    def receive(sample: zenoh.Sample) -> None:
        if link.is_signed(keys.HEALTH, sample.payload, sample.attachment):
            messages.put(as_bytes(sample.payload))

    listener = Listener(link.session, keys.HEALTH, receive)
    try:
        return decode(messages.get(timeout=timeout_s), ServoHealth)
    except queue.Empty as err:
        raise HalTimeoutError(
            f"bus: the HAL process at {config.endpoint} published no health within {timeout_s:g} s. Check its log.",
            code="no_health",
        ) from err
    finally:
        listener.close()
        link.close()


def describe_health(health: ServoHealth) -> str:
    """Return `health` in one line."""
    command = "no command owner"
    if health.owner:
        command = f"last command of {health.owner} {1e3 * health.command_age_s:.0f} ms ago"
    latency = ""
    if health.command_latency_ms_max:
        latency = (
            f"; command latency p50 {health.command_latency_ms_p50:.1f}, p99 {health.command_latency_ms_p99:.1f}, "
            f"max {health.command_latency_ms_max:.1f} ms"
        )
    faults = f"; {'; '.join(health.faults)}" if health.faults else ""
    return (
        f"servo {health.mode.value} at {health.rate_hz:.1f} Hz, period p50 {health.period_ms_p50:.2f}, "
        f"p99 {health.period_ms_p99:.2f}, max {health.period_ms_max:.1f} ms, {health.overruns} overruns in "
        f"{health.ticks} ticks; real time: {', '.join(health.real_time) or 'nothing granted'}; {command}"
        f"{latency}{faults}"
    )
