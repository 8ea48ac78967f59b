"""The keeper's process: it outlives a killed driver, and hands its arm over or lets it go."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig
from hal.backends.z1.keeper import control
from hal.base import z1
from hal.base.clock import WallClock
from hal.base.errors import CommandRejectedError, LeaseError
from hal.z1_protocol.states import Fsm
from scripts.arm import release_arm
from tests.support.errors import raises
from tests.support.hal.z1_peer import FakeController, serving

pytestmark = pytest.mark.integration

DRIVER = """
import sys, time
from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig
Z1Arm(None, Z1ArmConfig(command_port=int(sys.argv[1]), state_port=int(sys.argv[2]))).connect()
print("connected", flush=True)
time.sleep(600)
"""


@pytest.fixture
def peer() -> FakeController:
    peer = FakeController(WallClock(), np.append(z1.Q_HOME, -0.5))
    peer.rests = True
    return peer


@pytest.fixture
def config(peer: FakeController) -> Iterator[Z1ArmConfig]:
    with serving(peer) as (command_port, state_port):
        yield Z1ArmConfig(command_port=command_port, state_port=state_port)


def await_true(condition: Callable[[], bool]) -> None:
    clock, end_s = WallClock(), WallClock().now_s() + 20.0
    while not condition():
        assert clock.now_s() < end_s
        clock.sleep_until(clock.now_s() + 0.02)


def local(config: Z1ArmConfig) -> tuple[str, int]:
    return config.local_host, config.state_port


def test_a_killed_driver_leaves_a_held_arm_that_the_next_takes_over(peer: FakeController, config: Z1ArmConfig) -> None:
    ports = [str(config.command_port), str(config.state_port)]
    driver = subprocess.Popen([sys.executable, "-c", DRIVER, *ports], stdout=subprocess.PIPE, text=True)
    assert driver.stdout is not None
    assert driver.stdout.readline() == "connected\n"
    standby = control.find(local(config))
    assert standby is not None
    assert (standby.phase, standby.owner_pid) == ("standby", driver.pid)
    with raises(LeaseError, "port_in_use") as caught:
        Z1Arm(WallClock(), config).connect()
    assert str(driver.pid) in str(caught.value)
    with raises(CommandRejectedError, "keeper_busy"):
        control.release(local(config))
    driver.kill()
    driver.wait()
    driver.stdout.close()
    await_true(lambda: (found := control.find(local(config))) is not None and found.phase == "holding")
    received = len(peer.received)
    await_true(lambda: len(peer.received) > received + 5)
    assert peer.fsm is Fsm.JOINTCTRL

    second = Z1Arm(WallClock(), config)
    second.connect()
    found = control.find(local(config))
    assert found is not None
    assert found.pid != standby.pid
    second.disconnect()
    await_true(lambda: (found := control.find(local(config))) is not None and bool(found.q))
    options = release_arm.Config(arm=config, yes=True)
    assert release_arm.main(options) == 0
    assert peer.fsm is Fsm.PASSIVE
    assert control.find(local(config)) is None
    assert release_arm.main(options) == 1


def test_a_keeper_that_is_killed_is_started_again(config: Z1ArmConfig) -> None:
    arm = Z1Arm(WallClock(), config)
    arm.connect()
    first = control.find(local(config))
    assert first is not None
    subprocess.run(["kill", "-9", str(first.pid)], check=True)
    await_true(lambda: (found := control.find(local(config))) is not None and found.pid != first.pid)
    arm.go_passive()
    arm.disconnect()
    assert control.find(local(config)) is None  # a limp arm needs no keeper
