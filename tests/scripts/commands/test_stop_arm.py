"""`./z1 stop` and `./z1 rearm` against a HAL process of its own."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from hal.base.errors import StoppedError
from hal.base.messages import ServoMode, TrajectoryChunk
from hal.bus.client import RemoteArm
from hal.bus.session import BusConfig
from scripts import cli
from tests.support.errors import raises

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
