"""Connection of a conformance run to a controller: the twin's on a stepped clock, or a program on real ports."""

from __future__ import annotations

import socket
import subprocess
from abc import ABC, abstractmethod
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import numpy as np

from hal.base import z1
from hal.base.clock import WallClock
from hal.z1_protocol.controller import COMMAND_PORT, LABELS, STATE_PORT, ControllerState, decode_state, encode_command
from hal.z1_protocol.motor_board import BOARD_PORT, PERIOD_S
from hal.z1_protocol.records import JointCommands
from hal.z1_protocol.states import Fsm
from sim_twin.controller.controlled_world import ControlledWorld
from sim_twin.controller.motor_board import MotorBoard
from sim_twin.controller.motors import Motors
from sim_twin.drop_in.config import WireConfig
from sim_twin.drop_in.udp_server import WireServer
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World

LOOPBACK = "127.0.0.1"
_LATE_S = 1.5 * PERIOD_S
_START_TIMEOUT_S = 15.0  # the program checks its board, and then waits for a second
_END_TIMEOUT_S = 5.0


class Line(ABC):
    """Datagrams to a controller, its answers, and the commands that its motors received."""

    def __init__(self) -> None:
        self.answers: list[tuple[float, ControllerState]] = []
        """Time of arrival [s] and content of every answer."""
        self.commanded: list[JointCommands] = []
        """Every command that the motors received."""
        self.motors: Motors | None = None
        """The motors, to inject faults; None where they are real."""
        self.commands = self.late_commands = 0
        """Commands that the motors received, and those of them that came more than half a period late."""

    @abstractmethod
    def now_s(self) -> float:
        """Return the time [s]."""

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Send a datagram."""

    @abstractmethod
    def run(self, duration_s: float) -> None:
        """Let `duration_s` [s] pass, and collect the answers."""

    def record(self, motors: Motors) -> None:
        """Record the commands of these motors from now on."""
        self.motors, execute, last_s = motors, motors.handle_command, self.now_s()

        def handle_command(commands: JointCommands) -> None:
            nonlocal last_s
            now_s = self.now_s()
            self.commands += 1
            self.late_commands += now_s - last_s > _LATE_S
            last_s = now_s
            self.commanded.append(commands)
            execute(commands)

        motors.handle_command = handle_command  # pyright: ignore[reportAttributeAccessIssue]


class TwinLine(Line):
    """The twin's controller, in this process."""

    def __init__(self) -> None:
        super().__init__()
        self.twin = ControlledWorld(make_world())
        self.record(self.twin.motors)

    def now_s(self) -> float:
        return self.twin.world.time_s

    def send(self, data: bytes) -> None:
        self.twin.receive(data)

    def run(self, duration_s: float) -> None:
        end_s = self.now_s() + duration_s - 1e-9
        while self.now_s() < end_s:
            self.twin.tick()
            self.twin.world.step()
            if (answer := self.twin.reply()) is not None:
                self.answers.append((self.now_s(), decode_state(answer)))


class ProgramLine(Line):
    """A controller program as a child process, with the board twin behind it; a context manager.

    Args:
        program: the program; it reads `../config/config.xml`, of which it gets a copy.
        folder: folder for the copy.
        board: whether the board twin is started for it.
    """

    def __init__(self, program: Path, folder: Path, *, board: bool = True) -> None:
        super().__init__()
        self._clock = WallClock()
        self._program, self._folder, self._board = program, folder, board
        self._undo = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as undo:
            if self._board:
                board = MotorBoard(make_world())
                self.record(board.motors)
                undo.enter_context(WireServer(board, WireConfig(depth="board", host="0.0.0.0", board_port=BOARD_PORT)))
            self._socket = undo.enter_context(socket.socket(type=socket.SOCK_DGRAM))
            self._socket.bind((LOOPBACK, STATE_PORT))
            (self._folder / "bin").mkdir()
            process = subprocess.Popen(
                [self._program], cwd=self._folder / "bin", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            undo.callback(_end, process)
            self._undo = undo.pop_all()
        end_s = self.now_s() + _START_TIMEOUT_S
        while not self.answers and process.poll() is None and self.now_s() < end_s:
            self.run(0.1)
        if not self.answers:
            self._undo.close()
            raise RuntimeError(f"{self._program} does not answer on port {STATE_PORT} (exit code {process.poll()}).")
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()

    def now_s(self) -> float:
        return self._clock.now_s()

    def send(self, data: bytes) -> None:
        self._socket.sendto(data, (LOOPBACK, COMMAND_PORT))

    def run(self, duration_s: float) -> None:
        end_s = self.now_s() + duration_s
        while (left_s := end_s - self.now_s()) > 0.0:
            self._socket.settimeout(left_s)
            try:
                answer = self._socket.recv(4096)
            except TimeoutError:
                return
            self.answers.append((self.now_s(), decode_state(answer)))


def make_world() -> World:
    """Return the world of a run: an arm that is folded, as after power-on."""
    return World(SceneConfig(), np.append(LABELS["startFlat"], z1.GRIPPER_CLOSED))


def request(state: Fsm = Fsm.INVALID, *, q: np.ndarray, **values: np.ndarray) -> bytes:
    """Return a request whose body is the joints `q` (7,) [rad]."""
    return encode_command(state, JointCommands(q=q, **values))


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
