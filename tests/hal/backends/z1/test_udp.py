"""The real Z1's driver over real UDP, by the wall clock."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from threading import Event, Thread

import numpy as np
import pytest

from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig, Z1Mode
from hal.backends.z1.requests import RequestPhase
from hal.base import z1
from hal.base.clock import WallClock
from hal.base.errors import CommandRejectedError, HalTimeoutError, LeaseError
from hal.base.messages import ServoMode, TrajectoryChunk
from hal.rig import RIGS
from hal.servo.guard import Guard
from hal.servo.servo import Servo
from hal.servo.servo_thread import ServoThread
from hal.z1_protocol.states import Fsm
from tests.support.errors import raises
from tests.support.faults_table import FaultsTable
from tests.support.hal.z1_peer import FakeController, serving

pytestmark = pytest.mark.integration

BEGUN = (Fsm.TOSTATE, RequestPhase.DONE)


def resting_peer(shift: float = 0.0) -> FakeController:
    peer = FakeController(WallClock(), np.append(z1.Q_HOME + shift, -0.5))
    peer.rests = True
    return peer


@pytest.fixture
def peer() -> FakeController:
    return resting_peer()


@pytest.fixture
def config(peer: FakeController) -> Iterator[Z1ArmConfig]:
    with serving(peer) as (command_port, state_port):
        yield Z1ArmConfig(command_port=command_port, state_port=state_port)


def await_true(condition: Callable[[], bool], timeout_s: float = 20.0) -> None:
    clock, end_s = WallClock(), WallClock().now_s() + timeout_s
    while not condition():
        assert clock.now_s() < end_s
        clock.sleep_until(clock.now_s() + 0.01)


@pytest.mark.parametrize("mode", [Z1Mode.TRACKING, Z1Mode.LOW_LEVEL])
def test_the_servo_executes_a_trajectory_over_udp(peer: FakeController, config: Z1ArmConfig, mode: Z1Mode) -> None:
    clock = WallClock()
    arm = Z1Arm(clock, Z1ArmConfig(command_port=config.command_port, state_port=config.state_port, mode=mode))
    servo = Servo(arm, clock)
    servo.connect()
    with ServoThread(servo, clock):
        servo.claim("test")
        q = servo.status().q_command
        t_s = np.linspace(0, 1, 51)
        path = np.tile(q, (51, 1))
        path[:, 0] += 0.2 * (10 * t_s**3 - 15 * t_s**4 + 6 * t_s**5)
        speed = np.zeros_like(path)
        speed[:, 0] = 0.2 * (30 * t_s**2 - 60 * t_s**3 + 30 * t_s**4)
        servo.stream(TrajectoryChunk(trajectory_id=1, t_s=t_s, q=path, dq=speed, final=True))
        await_true(lambda: servo.status().finished or servo.status().mode is ServoMode.STOPPED)
        assert servo.status().reason == ""
    assert peer.q[0] - q[0] == pytest.approx(0.2, abs=0.02)
    servo.disconnect()
    assert peer.fsm is Fsm.JOINTCTRL


def test_without_a_controller_the_error_has_address_and_remedy() -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    arm = Z1Arm(WallClock(), Z1ArmConfig(command_port=port, state_port=port + 1, connect_timeout_s=0.2))
    with raises(HalTimeoutError, "no_controller") as caught:
        arm.connect()
    for part in (f"127.0.0.1:{port}", "within 0.2 s", "nothing listens on the port", "`z1_ctrl`"):
        assert part in str(caught.value)
    assert Z1ArmConfig().connect_timeout_s <= 2.5  # `--real` reports a missing arm within three seconds


@pytest.mark.faults
def test_a_second_client_is_rejected_and_the_first_continues(
    peer: FakeController, config: Z1ArmConfig, faults_table: FaultsTable
) -> None:
    first, second = Z1Arm(WallClock(), config), Z1Arm(WallClock(), config)
    first.connect()
    with raises(LeaseError, "port_in_use") as caught:
        second.connect()
    assert first.read_state().q == pytest.approx(peer.q, abs=1e-3)
    faults_table.add("second HAL on the arm's ports", arm="continues with the first", reads=caught.value)
    first.disconnect()
    second.connect()
    second.disconnect()


def test_two_arms_use_two_pairs_of_ports(peer: FakeController, config: Z1ArmConfig) -> None:
    other = resting_peer(shift=0.1)
    with serving(other) as (command_port, state_port):
        second = Z1ArmConfig(command_port=command_port, state_port=state_port)
        arms = [Z1Arm(WallClock(), one) for one in (config, second)]
        for arm in arms:
            arm.connect()
        assert arms[1].read_state().q[:6] - arms[0].read_state().q[:6] == pytest.approx(np.full(6, 0.1), abs=0.02)
        for arm in arms:
            arm.disconnect()


def test_a_stop_from_another_thread_ends_a_wait(peer: FakeController, config: Z1ArmConfig) -> None:
    arm = Z1Arm(WallClock(), config)
    arm.connect()
    peer.stuck = 1
    ended = Event()

    def run() -> None:
        with raises(CommandRejectedError, "motion_stopped"):
            arm.run_label("forward")
        ended.set()

    thread = Thread(target=run, daemon=True)
    thread.start()
    await_true(lambda: (last := arm._requests.last) is not None and (last.state, last.phase) == BEGUN)
    arm.stop()
    assert ended.wait(5.0)
    assert peer.fsm is Fsm.JOINTCTRL
    thread.join()
    arm.disconnect()


def test_the_real_rig_is_known_by_its_name() -> None:
    rig = RIGS.make("real", arm=Z1ArmConfig(connect_timeout_s=1.0), scene=None)
    assert isinstance(rig.arm, Z1Arm)
    assert rig.arm.config.connect_timeout_s == 1.0
    assert rig.find_arm is not None and rig.give_back is not None
    assert rig.park is not None
    assert rig.park.disable_motors == rig.arm.go_passive
    assert Guard().find_violation(np.append(rig.park.q, 0.0)[None], np.append(z1.Q_HOME, 0.0)) is None
    assert rig.call_every_tick is None
