"""The twin behind real ports, by the wall clock, and the real arm's driver connected to it."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig
from hal.base import z1
from hal.base.clock import WallClock
from hal.base.errors import HalError, InvalidValueError, LeaseError
from hal.z1_protocol.controller import LABELS, decode_state, encode_command
from hal.z1_protocol.records import JointCommands
from hal.z1_protocol.states import Fsm
from sim_twin.controller.controlled_world import ControlledWorld
from sim_twin.drop_in.config import WireConfig
from sim_twin.drop_in.rig import free_ports
from sim_twin.drop_in.udp_server import WireServer
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.errors import raises

pytestmark = pytest.mark.integration


def make_server() -> WireServer:
    command_port, state_port = free_ports()
    config = WireConfig(command_port=command_port, state_port=state_port)
    return WireServer(ControlledWorld(World(SceneConfig())), config)


@pytest.fixture
def server() -> Iterator[WireServer]:
    with make_server() as server:
        yield server


class Client:
    """A socket at the port of the answers."""

    def __init__(self, config: WireConfig) -> None:
        self._to = (config.host, config.command_port)
        self.socket = socket.socket(type=socket.SOCK_DGRAM)
        self.socket.bind((config.client_host, config.state_port))
        self.socket.settimeout(10.0)

    def exchange(self, data: bytes, answers: int = 4) -> bytes:
        """Send, and return the last of some answers: the controller answers before it reads and acts."""
        for _ in range(answers):
            self.socket.sendto(data, self._to)
            answer = self.socket.recv(4096)
        return answer

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()


def await_true(condition: Callable[[], bool], timeout_s: float = 30.0) -> None:
    clock = WallClock()
    end_s = clock.now_s() + timeout_s
    while not condition():
        assert clock.now_s() < end_s
        clock.sleep_until(clock.now_s() + 0.005)


def test_a_command_is_executed_and_answered(server: WireServer) -> None:
    with Client(server.config) as client:
        assert decode_state(client.exchange(encode_command(Fsm.INVALID))).state is Fsm.PASSIVE
        answer = decode_state(client.exchange(encode_command(Fsm.JOINTCTRL)))
    assert answer.state is Fsm.JOINTCTRL
    assert answer.joints.q[:6] == pytest.approx(z1.Q_HOME, abs=0.1)


def test_garbage_is_counted_and_the_next_command_executed(server: WireServer) -> None:
    rng = np.random.default_rng(0)
    with Client(server.config) as client:
        for size in (0, 1, 146, 148, 1400, 9000):
            client.socket.sendto(rng.bytes(size), (server.config.host, server.config.command_port))
        await_true(lambda: server.twin.invalid_datagrams == 6)
        client.exchange(encode_command(Fsm.JOINTCTRL))
        await_true(lambda: server.twin.controller.fsm is Fsm.JOINTCTRL)
    assert server.running


def test_a_motion_continues_without_its_client(server: WireServer) -> None:
    with Client(server.config) as client:
        q = decode_state(client.exchange(encode_command(Fsm.JOINTCTRL))).joints.q
        q[0] += 0.5
        client.exchange(encode_command(Fsm.INVALID, JointCommands(q=q), track=True))
    await_true(lambda: abs(server.twin.world.read_arm()[0][0] - q[0]) < 0.01)
    assert server.twin.controller.fsm is Fsm.JOINTCTRL


def test_silence_lets_the_arm_go_limp_while_the_answers_go_on(server: WireServer) -> None:
    with Client(server.config) as client:
        client.exchange(encode_command(Fsm.JOINTCTRL), answers=10)
        states = [Fsm.JOINTCTRL]
        while states[-1] is Fsm.JOINTCTRL and len(states) < 100:
            states.append(decode_state(client.socket.recv(4096)).state)
    assert states[-1] is Fsm.PASSIVE
    assert 10 < len(states) < 40


def test_a_second_client_is_executed_and_the_first_gets_the_answer(server: WireServer) -> None:
    with Client(server.config) as first, socket.socket(type=socket.SOCK_DGRAM) as second:
        assert decode_state(first.exchange(encode_command(Fsm.INVALID))).state is Fsm.PASSIVE
        second.sendto(encode_command(Fsm.JOINTCTRL), (server.config.host, server.config.command_port))
        states = [decode_state(first.socket.recv(4096)).state for _ in range(4)]
        assert states[-1] is Fsm.JOINTCTRL
        second.settimeout(0.05)
        with pytest.raises(TimeoutError):
            second.recv(4096)


def test_a_port_in_use_is_named(server: WireServer) -> None:
    with raises(LeaseError, "port_in_use") as caught:
        WireServer(server.twin, server.config).start()
    assert f"port 127.0.0.1:{server.config.command_port} is in use" in str(caught.value)


def test_an_address_of_another_machine_is_rejected(server: WireServer) -> None:
    with raises(HalError, "address_unavailable"):
        WireServer(server.twin, WireConfig(host="192.0.2.1")).start()
    with raises(InvalidValueError, "port") as caught:
        WireConfig(state_port=0)
    assert "state_port is 0; allowed are 1 to 65535" in str(caught.value)


def test_it_can_be_started_again_and_twice(server: WireServer) -> None:
    server.start()
    server.stop()
    server.stop()
    assert not server.running
    server.start()
    with Client(server.config) as client:
        assert len(client.exchange(encode_command(Fsm.INVALID))) == 208


def test_the_world_advances_without_a_client() -> None:
    steps: list[int] = []
    with make_server() as server:
        server.stop()
        counting = WireServer(server.twin, server.config, on_step=lambda: steps.append(1))
        with counting:
            await_true(lambda: len(steps) > 20)
    assert server.twin.world.time_s >= 0.002 * 20


def test_stop_raises_the_failure_of_the_thread() -> None:
    server = make_server()
    server.twin.world.step = lambda: 1 / 0  # pyright: ignore[reportAttributeAccessIssue] - a world that fails
    server.start()
    await_true(lambda: not server.running)
    with pytest.raises(ZeroDivisionError):
        server.stop()


# --- The real driver ------------------------------------------------------------------------------------------------


def test_two_arms_use_two_pairs_of_ports() -> None:
    with make_server() as one, make_server() as other:
        arms = [
            Z1Arm(WallClock(), Z1ArmConfig(command_port=c.command_port, state_port=c.state_port))
            for c in (one.config, other.config)
        ]
        for arm in arms:
            arm.connect()
        other_q = arms[1].read_state().q[:6]
        arms[0].run_label("forward")
        assert arms[0].read_state().q[:6] == pytest.approx(LABELS["forward"], abs=0.02)
        assert arms[1].read_state().q[:6] == pytest.approx(other_q, abs=0.05)
        for arm in arms:
            arm.disconnect()
