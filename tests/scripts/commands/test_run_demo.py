"""The demo end to end, as a user types it: processes, exit codes, files."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hal.base.clock import WallClock
from hal.base.messages import ServoMode, ServoStatus
from hal.bus import keys
from hal.bus.client import RemoteArm
from hal.bus.codec import decode
from hal.bus.service import Listener
from hal.bus.session import BusConfig, open_session
from scripts import cli

pytestmark = pytest.mark.integration

LIFTED_M = 0.05
TIMES = ("stage_ms", "servo", "zenoh")
SERVER_PERIOD_S = 0.010


@pytest.fixture(scope="module", autouse=True)
def default_ctrl_c() -> Iterator[None]:
    """Restore Ctrl-C, which a suite in the background of a shell ignores, and its children with it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def z1(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "scripts.cli", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def read_summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


# --- The pick -----------------------------------------------------------------------------------------------


def test_demo_lifts_the_bottle_with_two_processes_over_zenoh(tmp_path: Path) -> None:
    demo = z1("demo", f"--out={tmp_path}", f"--port={free_port()}")
    out, err = demo.communicate(timeout=240)
    assert demo.returncode == 0, err
    summary = read_summary(tmp_path)
    assert summary["success"] and summary["lifted_m"] >= LIFTED_M
    assert (summary["object"], summary["seed"]) == ("bottle", 0)
    assert summary["n_candidates"] == 800
    assert 0 < summary["n_after_mvb"] <= 800
    assert {"detect", "cloud", "generate", "mvbb", "ik", "collision", "plan", "total"} <= set(summary["stage_ms"])
    assert summary["servo"]["ticks"] > 500
    assert {"period_ms_p50", "period_ms_p999", "overruns"} <= set(summary["servo"])
    assert summary["zenoh"]["frame_ms_p99"] >= summary["zenoh"]["frame_ms_p50"] > 0.0
    assert (tmp_path / "grasp.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "episode.rrd").stat().st_size > 10_000
    for phase in ("start", "look", "decide", "transfer", "approach", "close", "lift", "hold"):
        assert phase in out


def test_in_lockstep_the_same_seed_gives_the_same_figures_in_any_process(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    options = ("demo", "--lockstep", "--object=box", "--seed=3")
    other = z1(*options, f"--out={there}")
    assert cli.main([*options, f"--out={here}"]) == 0
    _, err = other.communicate(timeout=240)
    assert other.returncode == 0, err
    first, second = ({k: v for k, v in read_summary(folder).items() if k not in TIMES} for folder in (here, there))
    assert first == second


def test_without_opengl_the_cylinder_is_lifted_and_drawn_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("Z1_TWIN_RENDER", "rays")
    assert cli.main(["demo", "--lockstep", "--object=cylinder", f"--out={tmp_path}"]) == 0
    assert read_summary(tmp_path)["success"]
    assert (tmp_path / "grasp.png").read_bytes().startswith(b"\x89PNG")


# --- What can go wrong --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "value"),
    [
        (["--object=teapot"], "teapot"),
        (["--distance-m=2.0"], "2.0"),
        (["--pitch-deg=nan"], "nan"),
        (["--detector=psychic"], "psychic"),
        (["--config=missing.yaml"], "missing.yaml"),
    ],
)
def test_bad_input_is_one_error_and_leaves_no_success(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], arguments: list[str], value: str
) -> None:
    (tmp_path / "summary.json").write_text('{"success": true}')
    assert cli.main(["demo", f"--out={tmp_path}", f"--port={free_port()}", *arguments]) == 2
    err = capfd.readouterr().err
    assert value in err
    assert err.startswith("error: ") and len(err.strip().splitlines()) == 1
    summary = tmp_path / "summary.json"
    assert not summary.exists() or not read_summary(tmp_path)["success"]


def test_taken_port_is_one_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert cli.main(["demo", f"--out={tmp_path}", f"--port={port}"]) == 1
    err = capfd.readouterr().err
    assert f"port {port}" in err and "Traceback" not in err
    assert not read_summary(tmp_path)["success"]


def demo_in_motion(out: Path) -> tuple[subprocess.Popen[str], int]:
    """Return a demo in mid-motion, and the id of its HAL process."""
    demo = z1("demo", f"--out={out}", f"--port={free_port()}")
    assert demo.stdout is not None
    for line in demo.stdout:
        if "decide" in line:
            break
    children = Path(f"/proc/{demo.pid}/task/{demo.pid}/children").read_text().split()
    (hal,) = [int(child) for child in children if b"\0hal\0" in Path(f"/proc/{child}/cmdline").read_bytes()]
    return demo, hal


def test_ctrl_c_in_mid_motion_ends_both_processes_in_order(tmp_path: Path) -> None:
    demo, hal = demo_in_motion(tmp_path)
    demo.send_signal(signal.SIGINT)
    _, err = demo.communicate(timeout=120)
    assert demo.returncode == 130
    assert err.endswith("interrupted\n") and "Traceback" not in err
    assert not Path(f"/proc/{hal}").exists()
    assert "Traceback" not in (tmp_path / "hal.log").read_text()
    assert not read_summary(tmp_path)["success"]


def test_killed_hal_in_mid_motion_is_one_error(tmp_path: Path) -> None:
    demo, hal = demo_in_motion(tmp_path)
    subprocess.run(["kill", "-KILL", str(hal)], check=True)
    _, err = demo.communicate(timeout=120)
    assert demo.returncode == 1
    errors = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and "Traceback" not in err, err
    assert "the HAL process ended" in errors[0] and "hal.log" in errors[0]
    assert read_summary(tmp_path)["error"] == errors[0].removeprefix("error: ")


# --- Stop and kill, on one HAL process ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def bus() -> Iterator[BusConfig]:
    """Start a HAL process of the twin."""
    bus = BusConfig(port=free_port(), connect_timeout_s=10.0)
    hal = z1("hal", "--hal=sim", f"--port={bus.port}")
    assert hal.stdout is not None and hal.stdout.readline().strip() == "ready"
    yield bus
    end(hal)
    assert hal.returncode == 0


@pytest.fixture
def runtime(bus: BusConfig) -> Iterator[subprocess.Popen[str]]:
    """Start a pick."""
    runtime = z1("run", f"--port={bus.port}")
    yield runtime
    end(runtime)


@pytest.fixture
def witness(bus: BusConfig) -> Iterator[RemoteArm]:
    with RemoteArm(bus, "witness", WallClock()) as arm:
        yield arm


def wait_for_motion(arm: RemoteArm, runtime: subprocess.Popen[str]) -> None:
    clock = WallClock()
    while runtime.poll() is None:
        if arm.status().mode is ServoMode.TRACKING and np.abs(arm.read_state().dq[:6]).max() > 0.3:
            return
        clock.sleep_until(clock.now_s() + 0.01)
    raise AssertionError(f"the arm never moved: {runtime.communicate()}")


def wait_for_rest(arm: RemoteArm) -> ServoStatus:
    clock = WallClock()
    while (status := arm.status()).mode in (ServoMode.TRACKING, ServoMode.BRAKING):
        clock.sleep_until(clock.now_s() + 0.005)
    return status


def assert_still(arm: RemoteArm, for_s: float = 0.5) -> None:
    clock = WallClock()
    clock.sleep_until(clock.now_s() + 0.2)  # the arm comes to rest after its command
    q_command, q = arm.status().q_command[:6], arm.read_state().q[:6]
    clock.sleep_until(clock.now_s() + for_s)
    assert np.array_equal(arm.status().q_command[:6], q_command)
    assert np.abs(arm.read_state().q[:6] - q).max() < 5e-3


def test_killing_the_runtime_in_mid_motion_brakes_the_arm_within_04_s(
    bus: BusConfig, runtime: subprocess.Popen[str], witness: RemoteArm
) -> None:
    wait_for_motion(witness, runtime)
    published: list[ServoStatus] = []
    session = open_session(bus, listen=False)
    listener = Listener(
        session, keys.STATUS, lambda sample: published.append(decode(sample.payload.to_bytes(), ServoStatus)), waiting=9
    )
    killed_s = WallClock().now_s()
    runtime.send_signal(signal.SIGKILL)
    held = wait_for_rest(witness)
    assert held.mode is ServoMode.HOLDING and not held.finished
    assert held.reason
    assert_still(witness)
    listener.close()
    session.close()
    # By the servo's own stamps, which the load of this process does not delay.
    rest_s = next(status.stamp_s for status in published if status.mode is ServoMode.HOLDING)
    assert rest_s - killed_s <= 0.4 + SERVER_PERIOD_S


def test_stop_in_mid_motion_latches_until_rearmed(
    bus: BusConfig, runtime: subprocess.Popen[str], witness: RemoteArm, capfd: pytest.CaptureFixture[str]
) -> None:
    wait_for_motion(witness, runtime)
    assert cli.main(["stop", f"--port={bus.port}"]) == 0
    assert wait_for_rest(witness).mode is ServoMode.STOPPED
    _, err = runtime.communicate(timeout=120)
    assert runtime.returncode == 1 and err.startswith("error: ")
    assert_still(witness)
    capfd.readouterr()
    assert cli.main(["run", f"--port={bus.port}"]) == 1
    assert "rearm" in capfd.readouterr().err
    assert witness.status().mode is ServoMode.STOPPED
    assert cli.main(["rearm", f"--port={bus.port}"]) == 0
    assert witness.status().mode is ServoMode.HOLDING


def end(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        process.communicate(timeout=20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
