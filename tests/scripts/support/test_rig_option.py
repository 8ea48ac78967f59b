"""One option selects the hardware, for `./z1 hal` and `./z1 demo`."""

from __future__ import annotations

import socket
import subprocess
import sys
from importlib.util import find_spec

import pytest
import tyro

from hal.backends.mock_arm import MockArm
from hal.backends.no_camera import NoCamera
from hal.base.errors import CommandRejectedError, InvalidValueError, LeaseError
from hal.bus.client import RemoteArm, RemoteCamera
from hal.bus.session import BusConfig
from hal.rig import RIGS
from scripts.commands import run_demo, run_hal
from scripts.support.rig_option import RigOption
from sim_twin.backends import TwinCamera
from sim_twin.drop_in.rig import free_ports
from tests.support.errors import raises


def free_tcp_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ([], "sim"),
        *((["--hal", name], name) for name in RIGS.names()),
        *(([f"--{name}"], name) for name in RIGS.names()),
    ],
)
def test_every_rig_has_its_flag_and_its_name(arguments: list[str], name: str) -> None:
    assert tyro.cli(run_hal.Config, args=arguments).rig.name == name


def test_two_flags_are_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        tyro.cli(run_hal.Config, args=["--real", "--sim"])
    assert "not allowed together" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ([], None),
        (["--arm", "z1", "--camera", "sim"], ("z1", "sim")),
        (["--arm", "sim", "--camera", "d405"], ("sim", "d405")),
        (["--real", "--camera", "sim"], ("z1", "sim")),
        (["--real", "--no-camera"], ("z1", "none")),
        (["--real", "--camera", "d405"], None),
        (["--mock", "--camera", "sim"], ("mock", "sim")),
        (["--wire-sim", "--no-camera"], None),
    ],
)
def test_arm_and_camera_are_selected_one_by_one(arguments: list[str], parts: tuple[str, str] | None) -> None:
    config = tyro.cli(run_hal.Config, args=[*arguments, "--arm.host", "192.0.2.1"])
    assert config.rig.parts == parts
    assert config.arm.host == "192.0.2.1"


def test_a_mixed_rig_is_made_from_the_options_without_its_devices() -> None:
    rig = run_hal.make_rig(tyro.cli(run_hal.Config, args=["--mock", "--camera", "sim", "--object", "box"]))
    assert isinstance(rig.arm, MockArm) and isinstance(rig.camera, TwinCamera)
    assert rig.camera.world.config.object == "box"
    rig = run_hal.make_rig(tyro.cli(run_hal.Config, args=["--mock", "--no-camera"]))
    assert isinstance(rig.camera, NoCamera)


def test_parts_of_a_whole_rig_and_two_cameras_are_rejected() -> None:
    with raises(InvalidValueError, "no_parts"):
        _ = RigOption(wire_sim=True, camera="d405").parts
    with raises(InvalidValueError, "two_cameras"):
        RigOption(camera="d405", no_camera=True)
    with raises(InvalidValueError, "no_ground_truth"):
        run_demo.Config(rig=RigOption(no_camera=True))


@pytest.mark.parametrize("rig", [RigOption(real=True), RigOption(mock=True)])
def test_demo_of_other_hardware_is_rejected_with_the_commands_for_it(rig: RigOption) -> None:
    with raises(InvalidValueError, "no_ground_truth") as caught:
        run_demo.Config(rig=rig)
    text = str(caught.value)
    assert (
        rig.name in text and "sim or wire-sim" in text and f"./z1 hal --hal {rig.name}" in text and "./z1 run" in text
    )


def test_lockstep_has_one_rig() -> None:
    with raises(InvalidValueError, "lockstep_rig"):
        run_demo.Config(rig=RigOption(wire_sim=True), lockstep=True)


@pytest.mark.integration
@pytest.mark.skipif(find_spec("pyrealsense2") is None, reason="pyrealsense2 has no wheel for this platform")
def test_without_arm_and_camera_the_error_names_address_and_device() -> None:
    command_port, state_port = free_ports()
    options = [f"--arm.command-port={command_port}", f"--arm.state-port={state_port}", f"--port={free_tcp_port()}"]
    command = [sys.executable, "-m", "scripts.cli", "hal", "--real", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    (error,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    for words in (f"127.0.0.1:{command_port}", f"127.0.0.1:{state_port}", "`z1_ctrl`", "8086:0B5B", "USB 3 port"):
        assert words in error


@pytest.mark.integration
def test_readonly_hal_publishes_states_and_frames_and_commands_nothing() -> None:
    bus = BusConfig(port=free_tcp_port(), connect_timeout_s=20.0)
    options = ["--mock", "--readonly", f"--port={bus.port}", "--until-stdin-closes"]
    command = [sys.executable, "-m", "scripts.cli", "hal", *options]
    hal = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert hal.stdin is not None and hal.stdout is not None
    try:
        assert any(line.strip() == "ready" for line in hal.stdout), "the HAL process ended at its start"
        with RemoteArm(bus) as arm, RemoteCamera(bus) as camera:
            assert arm.read_state().q.shape == (7,)
            assert camera.wait_for_frame(20.0).depth_m.any()
            with pytest.raises(LeaseError):
                arm.claim()
            with pytest.raises(CommandRejectedError):
                arm.stop("a person came near")
    finally:
        hal.stdin.close()
        assert hal.wait() == 0
        hal.stdout.close()
