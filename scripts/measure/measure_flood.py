"""Measure what a flood of messages on every key of the link does to the servo and to the stop.

    python -m scripts.measure.measure_flood --seconds 20

A HAL process with the mock arm runs through three phases, several times in turn: nothing else, a flood against it,
and the same flood against a Zenoh session of another process, which takes the same processor time. The flood is
unsigned, as any program on this machine could send it: puts on every topic and the heartbeat, queries of every service,
the stop among them. The stop's latency is the one of `./z1 stop`: from the request on the Unix socket to the answer,
which follows the latch. The target: the flood's ratio to the same load elsewhere is at most 1.2.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import tyro
import zenoh
from rich.console import Console
from rich.table import Table

from hal.backends.mock_arm import MockArm
from hal.backends.replay_camera import ReplayCamera
from hal.base.clock import Stopwatch, WallClock
from hal.base.errors import HalError
from hal.bus import keys
from hal.bus.server import HalServer
from hal.bus.session import BusConfig, open_session
from hal.bus.stop_socket import StopClient
from hal.servo.servo import Servo
from hal.servo.servo_thread import ServoThread
from hal.servo.status import PeriodStatistics
from scripts.measure.measure_bus import free_port, make_frames

_STOP_PERIOD_S = 0.02
_PUTS_PER_QUERY = 100
_TOPICS = (*keys.PUBLISHED, keys.HEARTBEAT)
PHASES = ("quiet", "flood", "flood elsewhere")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Extent of the measurement."""

    seconds: float = 20.0
    """Duration of each phase [s]."""
    rounds: int = 3
    """Number of times that the phases are run in turn."""
    rate_hz: float = 200_000
    """Messages a second that the flood attempts."""


def main(options: Options) -> None:
    """Print percentiles of the servo's period and of the stop's latency in each phase, and their ratios."""
    table = Table("phase", "messages/s", "period p99.9", "stop p50", "stop p99", "stop max", title="milliseconds")
    worst: dict[str, list[tuple[float, float]]] = {phase: [] for phase in PHASES}
    with _child("serve_hal") as hal, _child("serve_sink") as sink:
        ports = {"flood": hal.port, "flood elsewhere": sink.port}
        for _ in range(options.rounds):
            for phase in PHASES:
                rate_hz, p999_ms, stops_ms = _measure(options, hal, ports.get(phase))
                p50, p99 = np.percentile(stops_ms, [50, 99])
                table.add_row(
                    phase, f"{rate_hz:.0f}", f"{p999_ms:.3f}", f"{p50:.2f}", f"{p99:.2f}", f"{stops_ms.max():.2f}"
                )
                worst[phase].append((p999_ms, float(p99)))
    Console().print(table)
    medians = {phase: np.median(values, axis=0) for phase, values in worst.items()}
    for other in ("quiet", "flood elsewhere"):
        period, stop = medians["flood"] / medians[other]
        print(f"ratio of the medians, flood to {other}: period p99.9 {period:.2f}, stop p99 {stop:.2f}")


def _measure(options: Options, hal: _Child, port: int | None) -> tuple[float, float, np.ndarray]:
    """Return the flood's rate [1/s], the period's p99.9 [ms], and the stops' latencies (N,) [ms] of one phase."""
    clock, stops_ms = WallClock(), []
    client = StopClient("z1", hal.port, timeout_s=5.0)
    flood = None
    if port is not None:
        command = f"from scripts.measure.measure_flood import flood; flood({port}, {options.rate_hz})"
        flood = subprocess.Popen([sys.executable, "-c", command], stdout=subprocess.PIPE, text=True)
        assert flood.stdout is not None
        flood.stdout.readline()  # it has begun
    hal.ask("reset")
    end_s = clock.now_s() + options.seconds
    while clock.now_s() < end_s:
        watch = Stopwatch()
        client.stop("measure_flood")
        stops_ms.append(watch.lap_ms())
        clock.sleep_until(clock.now_s() + _STOP_PERIOD_S)
    p999_ms = float(hal.ask("report"))
    client.close()
    rate_hz = 0.0
    if flood is not None:
        flood.send_signal(signal.SIGTERM)
        rate_hz = float(flood.communicate()[0])
    return rate_hz, p999_ms, np.array(stops_ms)


# --- Processes ------------------------------------------------------------------------------------------------------


class _Child:
    """A process that runs a function of this module with a port, and answers lines by lines."""

    def __init__(self, function: str) -> None:
        self.port = free_port()
        command = f"from scripts.measure.measure_flood import {function}; {function}({self.port})"
        self._process = subprocess.Popen(
            [sys.executable, "-c", command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.ask("")

    def ask(self, line: str) -> str:
        """Return the answer to `line`."""
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None and stdout is not None
        stdin.write(line + "\n")
        stdin.flush()
        if not (answer := stdout.readline()):
            raise HalError("a process of the measurement ended; its error is above.")
        return answer.strip()

    def end(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


@contextmanager
def _child(function: str) -> Iterator[_Child]:
    child = _Child(function)
    try:
        yield child
    finally:
        child.end()


def serve_hal(port: int) -> None:
    """Serve a mock arm and a camera; `reset` begins a measurement of the periods, `report` prints its p99.9 [ms]."""
    clock = WallClock()
    servo, camera = Servo(MockArm(clock), clock, heartbeat_timeout_s=0.15), ReplayCamera(make_frames(), clock=clock)
    servo.connect()
    camera.connect()
    with ServoThread(servo, clock), HalServer(servo, camera, clock, BusConfig(port=port)):
        for line in sys.stdin:
            if line.strip() == "reset":
                periods = PeriodStatistics()
                periods.set_measuring(True)
                servo.periods = periods
            p999_ms = servo.periods.summary().p999_ms if line.strip() == "report" else 0.0
            print(p999_ms, flush=True)


def serve_sink(port: int) -> None:
    """Serve the same keys without Python behind them."""
    with open_session(BusConfig(port=port), listen=True):
        for _ in sys.stdin:
            print(flush=True)


def flood(port: int, rate_hz: float) -> None:
    """Send unsigned messages on every key until SIGTERM, then print the rate reached."""
    ended, clock, sent = [], WallClock(), 0
    signal.signal(signal.SIGTERM, lambda *_: ended.append(True))
    payload = os.urandom(200)
    with open_session(BusConfig(port=port), listen=False) as session:
        print("begun", flush=True)
        began_s = clock.now_s()
        while not ended:
            for _ in range(_PUTS_PER_QUERY // len(_TOPICS)):
                for key in _TOPICS:
                    session.put(key, payload, priority=zenoh.Priority.REAL_TIME)
            for key in keys.SERVICES:
                session.get(key, payload=payload, timeout=0.1)
            sent += _PUTS_PER_QUERY + len(keys.SERVICES)
            clock.sleep_until(began_s + sent / rate_hz)
    print(sent / (clock.now_s() - began_s), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
