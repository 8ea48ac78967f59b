"""`./z1 twin wire`: the twin's Z1 in place of the vendor's controller."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hal.wire.controller import LABELS, decode_state, encode_command
from hal.wire.states import Fsm
from scripts.run_demo import LIFTED_M
from scripts.run_demo import Config as DemoConfig
from scripts.run_wire import Config, make_server
from sim_twin.wire_rig import free_ports


@pytest.mark.parametrize("spelling", ["wire", "--wire"])
def test_a_client_is_answered_until_somebody_ends_it(spelling: str) -> None:
    command_port, state_port = free_ports()
    ports = [f"--command-port={command_port}", f"--state-port={state_port}"]
    command = [sys.executable, "-P", "-m", "scripts.cli", "twin", spelling, *ports]
    with (
        socket.socket(type=socket.SOCK_DGRAM) as client,
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process,
    ):
        assert process.stdout is not None
        try:
            assert f"127.0.0.1:{command_port}" in process.stdout.readline()
            assert process.stdout.readline() == "ready\n"
            client.bind(("127.0.0.1", state_port))
            client.settimeout(20.0)
            client.sendto(b"nonsense", ("127.0.0.1", command_port))
            client.sendto(encode_command(Fsm.INVALID), ("127.0.0.1", command_port))
            state = decode_state(client.recv(4096))
            assert state.state is Fsm.PASSIVE
            assert state.joints.q[:6] == pytest.approx(LABELS["startFlat"], abs=0.05)
            process.send_signal(signal.SIGINT)
            said = process.stdout.read()
            assert process.wait(20.0) == 0
        finally:
            process.kill()
    assert said.startswith("1 answers; 1 datagrams were no commands (the last one: a command has 8 bytes")


def test_the_folded_arm_rests_on_itself_in_passive() -> None:
    twin = make_server(Config()).twin
    twin.take(encode_command(Fsm.INVALID))
    for _ in range(1000):
        twin.tick()
        twin.world.step()
    q, dq, _ = twin.world.read_arm()
    assert q[:6] == pytest.approx(LABELS["startFlat"], abs=0.1)
    assert np.abs(dq).max() < 0.05


def test_home_is_where_the_camera_looks_from() -> None:
    assert make_server(Config(start="home", object="box")).twin.world.read_arm()[0][1] == pytest.approx(1.085, abs=0.01)


@pytest.mark.slow
def test_the_demo_lifts_the_bottle_through_both_real_drivers(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-P", "-m", "scripts.cli", "demo", "--hal=wire-sim", f"--out={tmp_path}"]
    subprocess.run([*command, f"--port={port}"], check=True, timeout=240)
    assert json.loads((tmp_path / "summary.json").read_text())["lifted_m"] >= LIFTED_M
    assert "Z1: connected to 127.0.0.1" in (tmp_path / "hal.log").read_text()


def test_a_demo_through_the_wire_cannot_be_in_lockstep() -> None:
    with pytest.raises(ValueError, match="leave out --hal wire-sim"):
        DemoConfig(hal="wire-sim", lockstep=True)
