"""`./z1 stop` and `./z1 rearm` against a HAL process of its own."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from hal.base.errors import HalError, StoppedError
from hal.base.messages import ServoMode, TrajectoryChunk
from hal.base.runtime_folder import find_file
from hal.bus.client import RemoteArm
from hal.bus.session import BusConfig
from scripts import cli
from scripts.commands.stop_arm import NOTHING_WAS_STOPPED
from tests.support.errors import raises
from tests.support.ports import free_tcp_port

pytestmark = pytest.mark.integration


@pytest.fixture
def port() -> Iterator[int]:
    """Return the port of a HAL process with the mock arm, which ends with the test."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        free = probe.getsockname()[1]
    command = [sys.executable, "-m", "scripts.cli", "hal", "--hal", "mock", "--port", str(free), "--until-stdin-closes"]
    hal = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert hal.stdin is not None and hal.stdout is not None
    try:
        assert any(line.strip() == "ready" for line in hal.stdout), "the HAL process ended at its start"
        yield free
    finally:
        hal.stdin.close()
        hal.wait()
        hal.stdout.close()


def test_stop_latches_until_rearm(port: int, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--port", str(port), "--connect-timeout-s", "5"]
    assert cli.main(["stop", *arguments, "--reason", "a test"]) == 0
    assert "servo: stopped (a test" in capsys.readouterr().out
    with RemoteArm(BusConfig(port=port)) as arm:
        q = arm.status().q_command
        stay = TrajectoryChunk(
            trajectory_id=1, t_s=np.array([0.0, 0.1]), q=np.array([q, q]), dq=np.zeros((2, 7)), final=True
        )
        arm.claim()
        with raises(StoppedError, "stopped") as caught:
            arm.stream(stay)
        assert "a test" in str(caught.value)  # the reason, over the bus
        assert cli.main(["rearm", *arguments]) == 0
        assert "servo: holding" in capsys.readouterr().out
        arm.claim()
        arm.stream(stay)
        assert arm.status().mode is not ServoMode.STOPPED


def test_without_a_hal_the_first_line_says_that_nothing_was_stopped_and_nothing_is_loaded() -> None:
    program = (
        "import sys; from scripts.cli import main; code = main(['stop', '--port', sys.argv[1]]); "
        "heavy = {'numpy', 'zenoh', 'tyro', 'yaml', 'importlib.metadata'} & set(sys.modules); "
        "print(code, *heavy)"
    )
    command = [sys.executable, "-S", "-c", program, str(free_tcp_port())]
    run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert run.stdout == "1\n", run.stderr
    assert run.stderr.splitlines()[0] == NOTHING_WAS_STOPPED
    assert "switch" in NOTHING_WAS_STOPPED.lower()


@pytest.mark.parametrize("options", [[], ["--host", "192.0.2.1"]])
def test_a_program_that_is_no_hal_is_not_taken_for_a_stopped_arm(
    options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        assert cli.main(["stop", "--port", str(port), "--connect-timeout-s", "0.3", *options]) != 0
    assert capsys.readouterr().err.splitlines()[0] == NOTHING_WAS_STOPPED


def test_stop_goes_over_the_link_where_there_is_no_socket(port: int, capsys: pytest.CaptureFixture[str]) -> None:
    path = find_file(f"z1-{port}.stop")
    assert path is not None
    path.unlink()
    assert cli.main(["stop", "--port", str(port), "--connect-timeout-s", "5", "--reason", "by the link"]) == 0
    assert "servo: stopped (by the link" in capsys.readouterr().out


def test_a_stop_to_the_hal_of_another_user_is_sent_but_not_taken_for_done(
    port: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with RemoteArm(BusConfig(port=port, connect_timeout_s=5)) as arm:
        with monkeypatch.context() as other_user:
            other_user.setattr("hal.bus.runtime_files.find_file", lambda name: None)
            other_user.setattr("hal.bus.stop_socket.find_file", lambda name: None)
            with raises(HalError, "unverified_hal"):
                RemoteArm(BusConfig(port=port)).connect()
            assert cli.main(["stop", "--port", str(port), "--connect-timeout-s", "5"]) == 1
        assert NOTHING_WAS_STOPPED not in capsys.readouterr().err.splitlines()[0]
        assert arm.status().mode is ServoMode.STOPPED
