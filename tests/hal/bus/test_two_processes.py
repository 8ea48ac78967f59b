"""The link between real processes, of which one is killed, ends, or gets a stop signal."""

from __future__ import annotations

import re
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

from hal.base.clock import WallClock
from hal.base.errors import HalTimeoutError
from hal.base.messages import ArmSetpoint, ServoMode
from hal.bus.client import RemoteArm, RemoteCamera
from tests.support.faults_table import FaultsTable, describe
from tests.support.hal.bus_hal import end_processes, free_config, moving, set_off, start_python, wait_until

pytestmark = pytest.mark.integration

BRAKED_WITHIN_S = 0.4
"""The safety requirement: from the death of the commanding process to the arm at rest [s]."""

MOVE = """
import sys
from tests.support.hal.bus_hal import slow_motion
from threading import Event
from hal.bus.client import RemoteArm, BusConfig
arm = RemoteArm(BusConfig(port=int(sys.argv[1])), owner="mortal")
arm.connect()
arm.claim()
arm.stream(slow_motion())
Event().wait()
"""
WATCH = """
import sys
from hal.bus.client import BusConfig, RemoteArm, RemoteCamera
config = BusConfig(port=int(sys.argv[1]))
arm, camera = RemoteArm(config), RemoteCamera(config)
arm.connect()
camera.connect()
arm.claim()
camera.wait_for_frame(5.0)
print("through shared memory" if camera.shared_memory else "as bytes", flush=True)
sys.stdin.readline()
if sys.argv[2] == "tidy":
    arm.disconnect()
    camera.disconnect()
if sys.argv[2] == "failing":
    raise SystemError("on purpose")
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

SERVE_TWICE = """
import sys
from threading import Event
from hal.backends.mock_arm import make_rig
from hal.bus.client import RemoteCamera
from hal.bus.session import BusConfig
from hal.process import serve

def watch():
    with RemoteCamera(config) as camera:
        camera.wait_for_frame(5.0)
        print(camera.shared_memory)
    end.set()

config, end = BusConfig(port=int(sys.argv[1])), Event()
end.set()
serve(make_rig(), config, end)
end.clear()
serve(make_rig(), config, end, on_ready=watch)
"""


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


@pytest.mark.faults
def test_a_killed_runtime_leaves_an_arm_that_brakes_and_holds(hal, recorded, faults_table: FaultsTable):
    runtime = start_python(MOVE, hal.config.port)
    try:
        wait_until(lambda: moving(hal.servo), 30.0)
        killed_s, q = WallClock().now_s(), hal.arm.read_state().q
    finally:
        end_processes(runtime)
    braking = wait_until(lambda: (s := hal.servo.status()).mode is not ServoMode.TRACKING and s)
    status = wait_until(lambda: (s := hal.servo.status()).mode is ServoMode.HOLDING and s)
    assert "heartbeat" in status.reason
    assert not status.finished
    assert killed_s < _last_motion_s(recorded) <= killed_s + BRAKED_WITHIN_S
    faults_table.add(
        "runtime killed",
        arm=describe(status, hal.arm.read_state().q - q),
        noticed_s=braking.stamp_s - killed_s,
        rest_s=_last_motion_s(recorded) - killed_s,
        reads=status.reason,
    )


def test_a_stop_from_another_process_holds_a_moving_arm_until_rearmed(hal, recorded):
    runtime = start_python(MOVE, hal.config.port)
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
        end_processes(runtime)


def _shared_memory_of(process: subprocess.Popen) -> set[Path]:
    """Return the shared-memory files of Zenoh that a process has mapped."""
    names = re.findall(r"/dev/shm/\S+\.zenoh", Path(f"/proc/{process.pid}/maps").read_text())
    return {Path(name) for name in names}


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="reads Linux's memory maps")
@pytest.mark.parametrize(
    ("manners", "number"), [("tidy", signal.SIGTERM), ("careless", signal.SIGINT), ("failing", signal.SIGTERM)]
)
def test_frames_cross_in_shared_memory_of_which_nothing_is_left_once_both_processes_have_ended(manners, number):
    config = free_config()
    server = start_python(SERVE, config.port)
    client = None
    try:
        assert server.stdout is not None
        assert server.stdout.readline() == "ready\n"
        client = start_python(WATCH, config.port, manners)
        assert client.stdout is not None
        assert client.stdout.readline() == "through shared memory\n"
        mapped = _shared_memory_of(server) | _shared_memory_of(client)
        assert any(path.exists() for path in mapped)
        _, errors = client.communicate("\n", timeout=60)  # a client that hangs at its end fails here
        assert client.returncode == (1 if manners == "failing" else 0)
        assert ("on purpose" in errors) == (manners == "failing")
        server.send_signal(number)
        server.communicate(timeout=60)
        assert server.returncode == 0
        assert [path for path in mapped if path.exists()] == []
    finally:
        end_processes(server, client)


def test_the_second_server_of_a_process_shares_memory_as_the_first():
    process = start_python(SERVE_TWICE, free_config().port)
    try:
        output, errors = process.communicate(timeout=60)
        assert (output, process.returncode) == ("True\n", 0), errors
    finally:
        end_processes(process)


@pytest.mark.faults
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_hal_process_that_gets_a_signal_in_motion_brakes_first(number, faults_table: FaultsTable):
    config = free_config(connect_timeout_s=20.0)
    process = start_python(SERVE, config.port)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        with RemoteArm(config) as arm, RemoteCamera(config) as camera:
            camera.wait_for_frame(5.0)
            arm.claim()
            wait_until(lambda: moving(arm) or set_off(arm), 60.0)
            process.send_signal(number)
            states, reads = [arm.read_state()], ""
            while process.poll() is None:
                try:
                    states.append(arm.read_state())
                except HalTimeoutError as error:
                    reads = str(error)
            assert process.stdout.read() == "ended\n"
            assert process.returncode == 0
        first, last = states[0], states[-1]
        assert np.abs(last.dq).max() < 0.02
        assert abs(last.q[0] - first.q[0]) < 0.3, "the motion of 0.6 rad was cut short"
        moving_s = [state.stamp_s for state in states if np.abs(state.dq).max() > 0.01]
        faults_table.add(
            f"HAL ended by {signal.Signals(number).name}",
            arm=f"brakes and holds; joint1 {1e3 * abs(last.q[0] - first.q[0]):.0f} mrad further",
            rest_s=max(moving_s) - first.stamp_s,
            reads=reads,
        )
    finally:
        end_processes(process)
