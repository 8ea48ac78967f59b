"""`./z1 run` against a HAL that cannot take a pick now: the answer comes before anything slow is loaded."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
import pytest

from hal.backends.mock_arm import MockArm
from hal.backends.replay_camera import ReplayCamera
from hal.base import z1
from hal.base.clock import WallClock
from hal.bus.client import RemoteArm
from hal.bus.server import HalServer
from hal.bus.session import BusConfig
from hal.servo.servo import Servo
from hal.servo.servo_thread import ServoThread
from scripts import cli
from tests.support.ports import free_tcp_port

pytestmark = pytest.mark.integration


@pytest.fixture
def bus() -> Iterator[BusConfig]:
    """Return the address of a HAL with a mock arm, in this process."""
    clock, bus = WallClock(), BusConfig(port=free_tcp_port())
    servo, camera = Servo(MockArm(clock, q=np.append(z1.Q_HOME, -1.0)), clock), ReplayCamera(clock=clock)
    servo.connect()
    camera.connect()
    with ServoThread(servo, clock), HalServer(servo, camera, clock, bus):
        yield bus


@pytest.fixture(autouse=True)
def nothing_slow(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("z1_runtime.robot", "z1_runtime.config", "z1_runtime.planning.planner"):
        monkeypatch.setitem(sys.modules, module, None)  # an import of it raises


def test_a_latched_stop_is_reported_first(bus: BusConfig, capsys: pytest.CaptureFixture[str]) -> None:
    with RemoteArm(bus) as arm:
        arm.stop("the red button")
    assert cli.main(["run", f"--port={bus.port}"]) == cli.FAILED
    error = capsys.readouterr().err
    assert "the red button" in error and "./z1 rearm" in error and error.count("\n") == 1


def test_a_lease_of_another_client_is_reported_first(bus: BusConfig, capsys: pytest.CaptureFixture[str]) -> None:
    with RemoteArm(bus, owner="console") as arm:
        arm.claim()
        assert cli.main(["run", f"--port={bus.port}"]) == cli.FAILED
        assert arm.status().owner.startswith("console")
    error = capsys.readouterr().err
    assert "console" in error and error.count("\n") == 1
