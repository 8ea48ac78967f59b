"""Measure the link between the HAL process and the runtime on this machine.

    python -m scripts.measure.measure_bus --seconds 10

A HAL process with the mock arm and a camera that replays 640×480 RGB-D frames at 30 Hz serves this process, as
`./z1 hal` serves `./z1 runtime`; both are real processes with a real link between them.
"""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from hal.backends.mock_arm import MockArm
from hal.backends.replay_camera import ReplayCamera
from hal.base.clock import Clock, Stopwatch, WallClock
from hal.base.errors import HalError, HalTimeoutError
from hal.base.messages import Intrinsics, RgbdFrame, TrajectoryChunk
from hal.base.z1 import N_JOINTS
from hal.bus import keys
from hal.bus.client import RemoteArm, RemoteCamera
from hal.bus.service import Listener
from hal.bus.session import BusConfig, open_session
from hal.process import serve, stop_on_signals
from hal.rig import Rig

_INTRINSICS = Intrinsics(width=640, height=480, fx=390.0, fy=390.0, cx=319.5, cy=239.5)  # about a D405's
_CHUNK_PERIOD_S = 0.02


@dataclass(frozen=True, kw_only=True)
class Options:
    """Extent of the measurement."""

    seconds: float = 10.0
    """Duration of each of the five measurements [s]."""


def main(options: Options) -> None:
    """Print percentiles of the latencies of everything that crosses the link."""
    table = Table("message", "p50", "p99", "max", "samples", title="the link between two processes, milliseconds")
    with hal_process() as config:
        for shared in (True, False):
            sent_ms, exposed_ms, was_shared = measure_frames(config, options.seconds, shared=shared)
            transport = "shared memory" if was_shared else "bytes"
            _add(table, f"frame, {transport}: sent to unpacked", sent_ms)
            _add(table, f"frame, {transport}: exposed to unpacked", exposed_ms)
        _add(table, "chunk: sent to acknowledged", measure_chunks(config, options.seconds))
        with _receive_frames(config):
            _add(table, "the same while frames flow", measure_chunks(config, options.seconds))
        gaps_ms = measure_states(config, options.seconds)
        _add(table, f"arm state: between two ({1e3 / gaps_ms.mean():.1f} a second)", gaps_ms)
    Console().print(table)


def _add(table: Table, name: str, values: np.ndarray) -> None:
    p50, p99 = np.percentile(values, [50, 99])
    table.add_row(name, f"{p50:.2f}", f"{p99:.2f}", f"{values.max():.2f}", str(len(values)))


# --- HAL process ------------------------------------------------------------------------------------------------


@contextmanager
def hal_process() -> Iterator[BusConfig]:
    """Run `serve_mock` in a process of its own on a free port."""
    port = free_port()
    command = [sys.executable, "-c", f"from scripts.measure.measure_bus import serve_mock; serve_mock({port})"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            if not process.stdout.readline():  # "ready", or nothing when it has ended
                raise HalError("the HAL process ended before it served; its error is above.")
            yield BusConfig(port=port)
        finally:
            process.send_signal(signal.SIGTERM)


def free_port() -> int:
    """Return a TCP port of the loopback that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))  # 0: of the system's choice
        return probe.getsockname()[1]


def serve_mock(port: int) -> None:
    """Serve a mock arm and a camera of the D405's size until SIGTERM."""
    ended = threading.Event()
    stop_on_signals(ended)
    clock = WallClock()
    rig = Rig(arm=MockArm(clock), camera=ReplayCamera(make_frames(), clock=clock), clock=clock)
    serve(rig, BusConfig(port=port), ended, on_ready=lambda: print("ready", flush=True))  # `hal_process` waits for it


def make_frames(n: int = 4) -> list[RgbdFrame]:
    """Return `n` different frames of noise: their contents do not affect the link."""
    rng = np.random.default_rng(0)
    size = (_INTRINSICS.height, _INTRINSICS.width)
    return [
        RgbdFrame(
            colour=rng.integers(0, 256, (*size, 3), dtype=np.uint8),
            depth_m=rng.uniform(0.1, 0.5, size).astype(np.float32),
            intrinsics=_INTRINSICS,
            stamp_s=i / 30,
            sequence=i,
        )
        for i in range(n)
    ]


# --- Runtime --------------------------------------------------------------------------------------------


def measure_frames(config: BusConfig, seconds: float, *, shared: bool) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the latencies (N,) of frames from sending and from exposure [ms], and whether memory was shared."""
    clock, exposed_ms = WallClock(), []
    with RemoteCamera(BusConfig(port=config.port, shared_memory=shared), clock) as camera:
        for _ in range(round(30 * seconds)):  # the recording's rate, 30 Hz
            frame = camera.wait_for_frame(2.0)
            exposed_ms.append(1e3 * (clock.now_s() - frame.stamp_s))
        return np.array(camera.frame_latencies_ms), np.array(exposed_ms), camera.shared_memory


def measure_chunks(config: BusConfig, seconds: float) -> np.ndarray:
    """Return the times (N,) from sending a chunk of 0.1 s to the servo's acknowledgement [ms]."""
    clock, acknowledged_ms = WallClock(), []
    with RemoteArm(config, owner="measure_bus") as arm:
        arm.claim()
        status = arm.status()
        q = np.tile(status.q_command, (6, 1))  # at rest: the link is measured, not the motion
        for count in range(1, round(seconds / _CHUNK_PERIOD_S)):
            chunk = TrajectoryChunk(
                trajectory_id=status.trajectory_id + count,  # a new one each, which has no seam to fit
                t_s=np.linspace(0, 0.1, 6),
                q=q,
                dq=np.zeros((6, N_JOINTS)),
                final=True,
            )
            watch = Stopwatch()
            arm.stream(chunk)
            acknowledged_ms.append(watch.lap_ms())
            clock.sleep_until(clock.now_s() + _CHUNK_PERIOD_S)
    return np.array(acknowledged_ms)


@contextmanager
def _receive_frames(config: BusConfig) -> Iterator[None]:
    ended = threading.Event()

    def watch(camera: RemoteCamera) -> None:
        while not ended.is_set():
            camera.wait_for_frame(2.0)

    with RemoteCamera(config) as camera:
        thread = threading.Thread(target=watch, args=(camera,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


def measure_states(config: BusConfig, seconds: float) -> np.ndarray:
    """Return the intervals (N,) between the arrivals of arm states [ms]."""
    clock: Clock = WallClock()
    arrived_s: list[float] = []
    with open_session(config, listen=False) as session:
        # 16 may wait: at the default of 1 a burst would lose arrivals.
        listener = Listener(session, keys.STATE, lambda _: arrived_s.append(clock.now_s()), waiting=16)
        clock.sleep_until(clock.now_s() + seconds)
        listener.close()
    if len(arrived_s) < 2:
        raise HalTimeoutError("the HAL process publishes no states.")
    return 1e3 * np.diff(arrived_s)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
