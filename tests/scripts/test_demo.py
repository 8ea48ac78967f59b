"""The main job end to end, as a user types it: processes, exit codes, files."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hal.bus.client import RemoteArm
from hal.bus.session import BusConfig
from hal.clock import WallClock
from hal.messages import ServoMode, ServoStatus

LIFTED_M = 0.05
TIMES = ("stage_ms", "servo", "zenoh")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def z1(*arguments: str, cwd: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "scripts.cli", *arguments],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run_z1(*arguments: str, cwd: Path) -> tuple[int, str, str]:
    process = z1(*arguments, cwd=cwd)
    out, err = process.communicate(timeout=240)
    return process.returncode, out, err


def read_summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def test_the_demo_lifts_the_bottle_with_two_processes_over_zenoh(tmp_path: Path) -> None:
    code, out, err = run_z1("demo", "--out=d", f"--port={free_port()}", cwd=tmp_path)
    assert code == 0, err
    summary = read_summary(tmp_path / "d")
    assert summary["success"] and summary["lifted_m"] >= LIFTED_M
    assert summary["n_candidates"] == 800
    assert 0 < summary["n_after_mvb"] <= 800
    assert {"detect", "cloud", "generate", "mvbb", "ik", "collision", "plan", "total"} <= set(summary["stage_ms"])
    assert summary["servo"]["ticks"] > 500
    assert 1.5 < summary["servo"]["period_ms_p50"] < 4.0
    assert summary["zenoh"]["frame_ms_p99"] >= summary["zenoh"]["frame_ms_p50"] > 0.0
    assert (tmp_path / "d" / "grasp.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "d" / "episode.rrd").stat().st_size > 10_000
    for phase in ("look", "decide", "transfer", "approach", "close", "lift", "hold"):
        assert phase in out


@pytest.mark.parametrize("name", ["box", "cylinder"])
def test_in_lockstep_the_same_seed_gives_the_same_figures(tmp_path: Path, name: str) -> None:
    summaries = []
    for folder in ("first", "second"):
        code, _, err = run_z1("demo", "--lockstep", f"--object={name}", "--seed=3", f"--out={folder}", cwd=tmp_path)
        assert code == 0, err
        summary = read_summary(tmp_path / folder)
        summaries.append({key: value for key, value in summary.items() if key not in TIMES})
    assert summaries[0] == summaries[1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--object=teapot"], "teapot"),
        (["--distance-m=2.0"], "2.0"),
        (["--pitch-deg=nan"], "nan"),
        (["--detector=psychic"], "psychic"),
        (["--config=missing.yaml"], "missing.yaml"),
    ],
)
def test_bad_input_is_one_clear_error_and_no_success_is_left_behind(
    tmp_path: Path, arguments: list[str], said: str
) -> None:
    code, _, err = run_z1("demo", "--out=d", f"--port={free_port()}", *arguments, cwd=tmp_path)
    assert code == 2
    assert said in err
    assert err.startswith("error: ") and len(err.strip().splitlines()) == 1
    assert not (tmp_path / "d" / "summary.json").exists()


def test_a_taken_port_is_one_clear_error(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        code, _, err = run_z1("demo", "--out=d", f"--port={port}", cwd=tmp_path)
    assert code == 1
    assert f"port {port}" in err and "Traceback" not in err


def watch_motion(bus: BusConfig) -> RemoteArm:
    """Return an arm that watches, once the demo moves it fast."""
    clock = WallClock()
    arm = RemoteArm(bus, "witness", clock)
    for _ in range(600):
        try:
            arm.connect()
            break
        except TimeoutError:
            clock.sleep_until(clock.now_s() + 0.1)
    for _ in range(3000):
        if arm.status().mode is ServoMode.TRACKING and np.abs(arm.read_state().dq[:6]).max() > 0.3:
            return arm
        clock.sleep_until(clock.now_s() + 0.01)
    raise AssertionError("the demo never moved the arm")


def follow_until_rest(arm: RemoteArm) -> list[ServoStatus]:
    clock = WallClock()
    seen = [arm.status()]
    while seen[-1].mode in (ServoMode.TRACKING, ServoMode.BRAKING) and len(seen) < 1000:
        clock.sleep_until(clock.now_s() + 0.005)
        seen.append(arm.status())
    return seen


def assert_still(arm: RemoteArm, for_s: float = 0.5) -> None:
    clock = WallClock()
    clock.sleep_until(clock.now_s() + 0.2)  # the arm comes to rest behind its command
    q_command, q = arm.status().q_command[:6], arm.read_state().q[:6]
    clock.sleep_until(clock.now_s() + for_s)
    assert np.array_equal(arm.status().q_command[:6], q_command)
    assert np.abs(arm.read_state().q[:6] - q).max() < 5e-3


def hal_beside(bus: BusConfig, folder: Path) -> subprocess.Popen[str]:
    return z1("hal", "--hal=sim", f"--port={bus.port}", cwd=folder)


def test_killing_the_runtime_in_mid_motion_brakes_the_arm_within_04_s(tmp_path: Path) -> None:
    bus = BusConfig(port=free_port(), connect_timeout_s=10.0)
    hal, runtime = hal_beside(bus, tmp_path), None
    try:
        assert hal.stdout is not None and hal.stdout.readline().strip() == "ready"
        runtime = z1("run", f"--port={bus.port}", cwd=tmp_path)
        arm = watch_motion(bus)
        last_alive = arm.status()
        runtime.send_signal(signal.SIGKILL)
        seen = follow_until_rest(arm)
        assert seen[-1].mode is ServoMode.HOLDING and not seen[-1].finished
        assert seen[-1].reason
        # The servo's own stamps: nothing here depends on when this test looked.
        assert seen[-1].stamp_s - last_alive.stamp_s <= 0.1 + 0.4
        assert_still(arm)
        arm.disconnect()
    finally:
        for process in (runtime, hal):
            if process is not None:
                end(process)


def test_stop_in_mid_motion_latches_until_rearmed(tmp_path: Path) -> None:
    bus = BusConfig(port=free_port(), connect_timeout_s=10.0)
    hal, runtime = hal_beside(bus, tmp_path), None
    try:
        assert hal.stdout is not None and hal.stdout.readline().strip() == "ready"
        runtime = z1("run", f"--port={bus.port}", cwd=tmp_path)
        arm = watch_motion(bus)
        code, _, err = run_z1("stop", f"--port={bus.port}", cwd=tmp_path)
        assert code == 0, err
        assert follow_until_rest(arm)[-1].mode is ServoMode.STOPPED
        _, said = runtime.communicate(timeout=60)
        assert runtime.returncode == 1 and said.startswith("error: ")
        assert_still(arm)
        code, _, said = run_z1("run", f"--port={bus.port}", cwd=tmp_path)
        assert code == 1 and "rearm" in said
        assert arm.status().mode is ServoMode.STOPPED
        code, _, err = run_z1("rearm", f"--port={bus.port}", cwd=tmp_path)
        assert code == 0, err
        assert arm.status().mode is ServoMode.HOLDING
        arm.disconnect()
    finally:
        for process in (runtime, hal):
            if process is not None:
                end(process)


def end(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        os.kill(process.pid, signal.SIGINT)
        try:
            process.communicate(timeout=20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
