"""The twin in place of the motor board, driven as by the vendor's controller, with bytes written by hand."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator

import numpy as np
import pytest

from hal.base import z1
from hal.base.clock import WallClock
from hal.base.z1_dynamics import FeedForward
from hal.z1_protocol.records import MotorError, MotorLink
from sim_twin.controller.motor_board import MotorBoard
from sim_twin.drop_in.config import WireConfig
from sim_twin.drop_in.rig import free_ports
from sim_twin.drop_in.udp_server import WireServer
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World

START = np.append(z1.Q_HOME, -1.0)
K_P = (25.0, 30.0, 20.0, 20.0, 15.0, 30.0, 5.0)
"""Gains of the vendor's controller in JOINTCTRL (measured)."""
K_W = (2000.0, 3000.0, 3000.0, 3000.0, 2000.0, 2000.0, 100.0)


def command(q: np.ndarray, tau: np.ndarray, n: int = 7) -> bytes:
    """T, W, Pos, K_P, K_W of each joint as little-endian floats."""
    return b"".join(struct.pack("<5f", tau[i], 0.0, q[i], K_P[i], K_W[i]) for i in range(n))


def positions(state: bytes) -> np.ndarray:
    """T, W, Acc, Pos and two motors of 3 bytes a joint."""
    return np.array([struct.unpack_from("<f", state, 22 * i + 12)[0] for i in range(len(state) // 22)])


@pytest.fixture
def board() -> MotorBoard:
    return MotorBoard(World(SceneConfig()))


class Controller:
    """The vendor's side: position commands with gravity compensation."""

    def __init__(self) -> None:
        self._feed_forward = FeedForward()

    def command(self, state: bytes, q: np.ndarray) -> bytes:
        return command(q, self._feed_forward.torque(positions(state), np.zeros(7)))

    def drive(self, board: MotorBoard, goals: list[np.ndarray]) -> bytes:
        """Exchange at 250 Hz, one goal after the other; return the last state."""
        state = board.receive(bytes(140))
        for q in goals:
            assert state is not None
            state = board.receive(self.command(state, q))
            for _ in range(2):
                board.tick()
                board.world.step()
        assert state is not None
        return state


def test_the_self_check_is_answered_motor_by_motor(board: MotorBoard) -> None:
    assert board.receive(b"\x02") == bytes.fromhex("20 08 01 01 01 01 01 01 01 01")
    board.motors.link[1, 1] = MotorLink.LOST
    assert board.receive(b"\x02") == bytes.fromhex("20 08 01 01 00 01 01 01 01 01")


def test_without_a_gripper_there_are_seven_motors_and_six_records() -> None:
    board = MotorBoard(World(SceneConfig()), gripper=False)
    assert board.receive(b"\x02") == bytes.fromhex("20 07 01 01 01 01 01 01 01")
    answer = board.receive(bytes(120))
    assert answer is not None
    assert len(answer) == 132
    assert board.receive(bytes(140)) is None
    assert "140 bytes; allowed with 6 joints are 120" in board.invalid_reason


def test_zeros_are_answered_with_154_bytes_of_measurements(board: MotorBoard) -> None:
    state = board.receive(bytes(140))
    assert state is not None
    assert len(state) == 154
    assert positions(state) == pytest.approx(START, abs=0.02)
    assert state[16:22] == bytes([30, 0, 0, 30, 0, 0])  # 30 °C, no error, connected


def test_the_arm_is_parked_until_the_first_command_and_then_without_torque(board: MotorBoard) -> None:
    board.receive(b"\x02")
    for _ in range(250):
        board.tick()
        board.world.step()
    assert board.world.read_arm()[0] == pytest.approx(START, abs=0.02)
    state = Controller().drive(board, [])
    for _ in range(100):
        board.tick()
        board.world.step()
    assert np.abs(board.world.read_arm()[0] - positions(state)).max() > 0.05


def test_the_vendors_gains_hold_the_arm_and_move_it(board: MotorBoard) -> None:
    controller = Controller()
    state = controller.drive(board, [START] * 250)
    assert positions(state) == pytest.approx(START, abs=0.02)
    goal = START + np.array([0.2, 0.1, -0.1, 0.1, -0.1, 0.2, 0.3])
    ramp = [START + ratio * (goal - START) for ratio in np.linspace(0.0, 1.0, 125)]
    state = controller.drive(board, [*ramp, *[goal] * 125])
    assert positions(state) == pytest.approx(goal, abs=0.02)


def test_a_motor_record_reports_its_faults(board: MotorBoard) -> None:
    board.motors.error[1, 1] = MotorError.OVERHEAT
    board.motors.link[4, 0] = MotorLink.CRC_ERROR
    board.motors.temperature_c[1, 1] = 71.4
    state = board.receive(bytes(140))
    assert state is not None
    assert state[22 + 19 : 22 + 22] == bytes([71, 0x04, 0])
    assert state[4 * 22 + 16 : 4 * 22 + 19] == bytes([30, 0, 2 << 6])


def test_a_silent_board_answers_nothing_and_forwards_nothing(board: MotorBoard) -> None:
    Controller().drive(board, [START] * 100)
    board.motors.silent = True
    assert board.receive(b"\x02") is None
    assert board.receive(command(START, np.zeros(7))) is None
    for _ in range(250):
        board.tick()
        board.world.step()
    assert np.abs(board.world.read_arm()[0] - START).max() > 0.1
    board.motors.silent = False
    assert board.receive(b"\x02") is not None


@pytest.mark.parametrize("at", [0, 4, 8, 12, 16])
def test_a_value_that_is_not_finite_is_rejected_and_moves_nothing(board: MotorBoard, at: int) -> None:
    board.receive(command(START, np.zeros(7)))
    bad = bytearray(command(START, np.zeros(7)))
    bad[at : at + 4] = struct.pack("<f", float("nan"))
    assert board.receive(bytes(bad)) is None
    assert board.invalid_datagrams == 1
    assert "must be finite" in board.invalid_reason


@pytest.mark.integration
def test_random_bytes_are_counted_and_never_crash(board: MotorBoard) -> None:
    rng = np.random.default_rng(3)
    good = command(START, np.zeros(7))
    for i in range(5000):
        data = bytearray(good)
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        kinds = (bytes(data), bytes(data[: rng.integers(140)]), rng.bytes(140), rng.bytes(int(rng.integers(0, 400))))
        answer = board.receive(kinds[i % 4])
        assert answer is None or len(answer) in (10, 154)
        if i % 10 == 0:
            board.tick()
            board.world.step()
    assert board.invalid_datagrams > 1500
    assert np.isfinite(board.world.read_arm()[0]).all()
    assert not board.world.data.warning.number.any()


# --- Over UDP -------------------------------------------------------------------------------------------------------


@pytest.fixture
def ports() -> Iterator[list[int]]:
    configs = [WireConfig(depth="board", board_port=port) for port in free_ports()]
    servers = [WireServer(MotorBoard(World(SceneConfig())), config) for config in configs]
    with servers[0], servers[1]:
        yield [config.board_port for config in configs]


def link(port: int) -> socket.socket:
    client = socket.socket(type=socket.SOCK_DGRAM)
    client.bind(("127.0.0.1", 0))
    client.connect(("127.0.0.1", port))
    client.settimeout(5.0)
    return client


def exchange(client: socket.socket, data: bytes) -> bytes:
    client.send(data)
    return client.recv(4096)


@pytest.mark.integration
def test_a_controller_starts_two_arms_and_moves_one(ports: list[int]) -> None:
    clock, controller = WallClock(), Controller()
    with link(ports[0]) as one, link(ports[1]) as other:
        for client in (one, other):
            assert exchange(client, b"\x02") == bytes.fromhex("20 08 01 01 01 01 01 01 01 01")
            assert len(exchange(client, bytes(140))) == 154
        states = [exchange(client, command(START, np.zeros(7))) for client in (one, other)]
        goals = [START + 0.2 * np.eye(7)[0], START]
        for i in range(500):
            due_s = clock.now_s() + 0.004
            ratio = min(i / 250, 1.0)
            for k, client in enumerate((one, other)):
                q = START + ratio * (goals[k] - START)
                states[k] = exchange(client, controller.command(states[k], q))
            clock.sleep_until(due_s)
        one.send(b"nonsense")
        one.send(bytes(139))
        assert len(exchange(one, bytes(140))) == 154
    assert positions(states[0])[0] == pytest.approx(goals[0][0], abs=0.05)
    assert positions(states[1])[0] == pytest.approx(START[0], abs=0.05)


def test_a_calibration_makes_the_present_pose_the_zero_of_measurements_and_commands(board: MotorBoard) -> None:
    Controller().drive(board, [START] * 50)
    assert board.receive(b"\x01") == b"\x10"
    state = board.receive(bytes(140))
    assert state is not None
    assert positions(state) == pytest.approx(np.append(np.zeros(6), START[6]), abs=0.01)
    hold = command(np.append(np.zeros(6), START[6]), FeedForward().torque(START, np.zeros(7)))
    for _ in range(200):
        board.receive(hold)
        board.tick()
        board.world.step()
    assert board.world.read_arm()[0] == pytest.approx(START, abs=0.05)
