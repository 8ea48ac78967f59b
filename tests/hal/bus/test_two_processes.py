"""The link between real processes: what happens when one of them dies, ends, or is told to stop."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from conftest import free_config, moving, wait_until

from hal.bus.client import RemoteArm, RemoteCamera
from hal.clock import WallClock
from hal.errors import HalTimeoutError
from hal.messages import ArmSetpoint, ServoMode

ROOT = Path(__file__).parents[3]
BRAKED_WITHIN_S = 0.4
"""The safety requirement: from the death of the commanding process to the arm at rest [s]."""

MOVE = """
import sys
sys.path.insert(0, sys.argv[2])
from conftest import slow_motion
from threading import Event
from hal.bus.client import RemoteArm, BusConfig
arm = RemoteArm(BusConfig(port=int(sys.argv[1])), owner="mortal")
arm.connect()
arm.claim()
arm.stream(slow_motion())
Event().wait()
"""
LOOK = """
import sys
from hal.bus.client import BusConfig, RemoteArm, RemoteCamera
config = BusConfig(port=int(sys.argv[1]))
arm, camera = RemoteArm(config), RemoteCamera(config)
arm.connect()
camera.connect()
arm.claim()
camera.wait_for_frame(5.0)
if sys.argv[2] == "tidy":
    arm.disconnect()
    camera.disconnect()
print("seen")
"""
SERVE = """
import sys
from threading import Event
from hal.backends.mock_arm import make_rig
from hal.bus.session import BusConfig
from hal.process import serve, stop_on_signals
end = Event()
stop_on_signals(end)
serve(make_rig(), BusConfig(port=int(sys.argv[1])), end, on_ready=lambda: print("ready", flush=True))
print("ended", flush=True)
"""


def _start(code: str, *arguments: object) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


@pytest.fixture
def recorded(hal, monkeypatch):
    """Every setpoint that reaches the arm, with its time."""
    sent: list[tuple[float, np.ndarray]] = []
    clock, send = WallClock(), hal.arm.send

    def record(setpoint: ArmSetpoint) -> ArmSetpoint:
        sent.append((clock.now_s(), setpoint.q))
        return send(setpoint)

    monkeypatch.setattr(hal.arm, "send", record)
    return sent


def _last_motion_s(sent: list[tuple[float, np.ndarray]]) -> float:
    """Return when the setpoint last changed [s]."""
    q = np.array([q for _, q in sent])
    changed = np.abs(np.diff(q, axis=0)).max(axis=1) > 1e-9
    return sent[int(np.flatnonzero(changed)[-1]) + 1][0]


def test_a_killed_runtime_leaves_an_arm_that_brakes_and_holds(hal, recorded):
    runtime = _start(MOVE, hal.config.port, Path(__file__).parent)
    try:
        wait_until(lambda: moving(hal.servo), 30.0)
        killed_s = WallClock().now_s()
    finally:
        runtime.kill()
        runtime.wait()
    wait_until(lambda: hal.servo.status().mode is ServoMode.HOLDING)
    status = hal.servo.status()
    assert "heartbeat" in status.reason
    assert not status.finished
    assert killed_s < _last_motion_s(recorded) <= killed_s + BRAKED_WITHIN_S


def test_a_stop_from_another_process_holds_a_moving_arm_until_rearmed(hal, recorded):
    runtime = _start(MOVE, hal.config.port, Path(__file__).parent)
    try:
        wait_until(lambda: moving(hal.servo), 30.0)
        with RemoteArm(hal.config, owner="z1 stop") as bystander:
            stopped_s = WallClock().now_s()
            bystander.stop()
            wait_until(lambda: bystander.status().mode is ServoMode.STOPPED)
            count = len(recorded)
            wait_until(lambda: len(recorded) > count + 50)
            assert _last_motion_s(recorded) <= stopped_s + BRAKED_WITHIN_S
            assert runtime.poll() is None
    finally:
        runtime.kill()
        runtime.wait()


@pytest.mark.parametrize("manners", ["tidy"])
def test_a_client_ends_without_hanging_and_leaves_no_shared_memory(hal, manners):
    before = set(Path("/dev/shm").glob("*.zenoh"))
    client = _start(LOOK, hal.config.port, manners)
    output, _ = client.communicate(timeout=60)
    assert output == "seen\n"
    assert client.returncode == 0
    if manners == "tidy":
        assert set(Path("/dev/shm").glob("*.zenoh")) <= before


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_hal_process_told_to_end_in_motion_brakes_first(number):
    config = free_config(connect_timeout_s=20.0)
    process = _start(SERVE, config.port)
    runtime = None
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        with RemoteArm(config) as arm, RemoteCamera(config) as camera:
            runtime = _start(MOVE, config.port, Path(__file__).parent)
            wait_until(lambda: moving(arm), 30.0)
            camera.wait_for_frame(5.0)
            process.send_signal(number)
            last = arm.read_state()
            while process.poll() is None:
                with suppress(HalTimeoutError):
                    last = arm.read_state()
            assert process.stdout.read() == "ended\n"
            assert process.returncode == 0
        assert np.abs(last.dq).max() < 0.01
        assert 0.0 < last.q[0] < 0.5, "the motion of 0.6 rad was cut short"
    finally:
        process.kill()
        process.wait()
        if runtime is not None:
            runtime.kill()
            runtime.wait()
