"""Helpers for a HAL on a free loopback port, in this process or in another one."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from threading import Event

import numpy as np

from hal.backends.mock_arm import MockArm
from hal.backends.replay_camera import ReplayCamera
from hal.base.clock import WallClock
from hal.base.messages import ServoMode, TrajectoryChunk
from hal.base.z1 import N_JOINTS, Q_HOME
from hal.bus.server import HalServer
from hal.bus.session import BusConfig
from hal.servo.servo import Servo

ROOT = Path(__file__).parents[3]


@dataclass
class Hal:
    """One running HAL with its devices."""

    config: BusConfig
    arm: MockArm
    camera: ReplayCamera
    servo: Servo
    server: HalServer


def free_config(**options) -> BusConfig:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    return BusConfig(port=port, **options)


HOME = np.append(Q_HOME, 0.0)


def slow_motion(trajectory_id: int = 1, duration_s: float = 3.0, start: np.ndarray = HOME) -> TrajectoryChunk:
    """Return a smooth motion of joint 1 by 0.6 rad from `start`."""
    s = np.linspace(0.0, 1.0, int(50 * duration_s) + 1)
    q = np.tile(start, (len(s), 1))
    dq = np.zeros((len(s), N_JOINTS))
    q[:, 0] += 0.6 * (10 * s**3 - 15 * s**4 + 6 * s**5)
    dq[:, 0] = 0.6 * (30 * s**2 - 60 * s**3 + 30 * s**4) / duration_s
    return TrajectoryChunk(trajectory_id=trajectory_id, t_s=s * duration_s, q=q, dq=dq, final=True)


def wait_until(condition, timeout_s: float = 10.0):
    """Return the first true value of `condition()`; fail when there is none for long (a bound for hangs only)."""
    clock, pause = WallClock(), Event()
    give_up_s = clock.now_s() + timeout_s
    while not (value := condition()):
        assert clock.now_s() < give_up_s, f"the condition is false after {timeout_s} s"
        pause.wait(0.005)
    return value


def start_python(code: str, *arguments: object) -> subprocess.Popen:
    """Start a Python program that finds this tree's packages; its streams are pipes of text."""
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


def end_processes(*processes: subprocess.Popen | None) -> None:
    """Kill the processes and wait for their end."""
    for process in processes:
        if process is not None:
            process.kill()
            process.communicate()


def moving(servo) -> bool:
    status = servo.status()
    return status.mode is ServoMode.TRACKING and status.trajectory_time_s > 0.3


def set_off(arm) -> None:
    """Start a motion if the arm holds: on a busy machine an earlier one may have ended by a late heartbeat."""
    status = arm.status()
    if status.mode is ServoMode.HOLDING:
        arm.stream(slow_motion(status.trajectory_id + 1, start=status.q_command))
