"""`./z1 twin wire`: the twin's Z1 in place of the vendor's controller."""

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

from hal.base.errors import InvalidValueError
from hal.z1_protocol.controller import LABELS, decode_state, encode_command
from hal.z1_protocol.states import Fsm
from scripts.commands.run_demo import LIFTED_M
from scripts.commands.run_demo import Config as DemoConfig
from scripts.commands.run_wire import Config, make_scene, start_pose
from scripts.support.rig_option import RigOption
from sim_twin.drop_in.process import make_twin
from sim_twin.drop_in.rig import free_ports


@pytest.mark.integration
@pytest.mark.parametrize("spelling", ["wire", "--wire"])
def test_a_client_is_answered_until_the_signal(spelling: str) -> None:
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
            summary = process.stdout.read()
            assert process.wait(20.0) == 0
        finally:
            process.kill()
    assert "answers; 1 invalid datagrams (the last one: a command has 8 bytes" in summary


@pytest.mark.integration
def test_the_folded_arm_rests_on_itself_in_passive() -> None:
    config = Config()
    twin = make_twin(make_scene(config), config.wire, start_pose(config.start))
    twin.receive(encode_command(Fsm.INVALID))
    for _ in range(1000):
        twin.tick()
        twin.world.step()
    q, dq, _ = twin.world.read_arm()
    assert q[:6] == pytest.approx(LABELS["startFlat"], abs=0.1)
    assert np.abs(dq).max() < 0.05


@pytest.mark.integration
def test_home_is_the_cameras_viewpoint() -> None:
    config = Config(start="home", object="box")
    twin = make_twin(make_scene(config), config.wire, start_pose(config.start))
    assert twin.world.read_arm()[0][1] == pytest.approx(1.085, abs=0.01)


@pytest.mark.integration
def test_as_motor_board_it_is_checked_and_driven_by_a_controller_and_shown_in_rerun() -> None:
    port, view_port = free_ports()
    options = ["--depth=board", f"--board-port={port}", "--view", f"--view-port={view_port}"]
    command = [sys.executable, "-P", "-m", "scripts.cli", "twin", "wire", *options]
    with (
        socket.socket(type=socket.SOCK_DGRAM) as controller,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process,
    ):
        assert process.stdout is not None
        assert process.stderr is not None
        try:
            assert f"board listens on 127.0.0.1:{port}" in process.stdout.readline()
            assert process.stdout.readline() == "ready\n"
            controller.settimeout(20.0)
            controller.connect(("127.0.0.1", port))
            controller.send(b"\x02")
            assert controller.recv(4096) == bytes.fromhex("20 08 01 01 01 01 01 01 01 01")
            controller.send(bytes(140))
            assert len(controller.recv(4096)) == 154
            if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
                assert f"127.0.0.1:{view_port}" in process.stderr.readline()  # address of the live view
            process.send_signal(signal.SIGINT)
            assert process.stdout.read() == "2 answers; 0 invalid datagrams\n"
            assert process.wait(20.0) == 0
        finally:
            process.kill()


@pytest.mark.slow
@pytest.mark.integration
def test_the_demo_lifts_the_bottle_through_both_real_drivers(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-P", "-m", "scripts.cli", "demo", "--hal=wire-sim", f"--out={tmp_path}"]
    subprocess.run([*command, f"--port={port}"], check=True, timeout=240)
    assert json.loads((tmp_path / "summary.json").read_text())["lifted_m"] >= LIFTED_M
    assert "Z1: connected to 127.0.0.1" in (tmp_path / "hal.log").read_text()


def test_a_demo_over_the_vendors_protocol_cannot_be_in_lockstep() -> None:
    with pytest.raises(InvalidValueError):
        DemoConfig(rig=RigOption(wire_sim=True), lockstep=True)
