"""A simulated arm behind the vendor's controller: datagrams in, datagrams out, and a tick of 2 ms for both."""

from __future__ import annotations

import numpy as np

from hal.base import z1
from hal.z1_protocol.controller import decode_command, encode_state
from hal.z1_protocol.motor_board import PERIOD_S
from hal.z1_protocol.records import JointStates, ProtocolError
from hal.z1_protocol.states import Fsm
from sim_twin.controller.controller import Controller
from sim_twin.controller.motors import Motors
from sim_twin.model.world import World

_BOARD_TICKS = round(PERIOD_S / z1.CONTROL_PERIOD_S)


class ControlledWorld:
    """Controller and motors of one world; no sockets, no clock, no thread.

    Until the first command the motors get none, and the arm stays parked. The controller works, and exchanges commands
    and measurements with the motors, at 250 Hz, so every second answer repeats the measurement.

    Args:
        world: world of the arm; its owner calls `tick` before each of its steps.
        injected_faults: a record of `sim_twin.controller.fault_injection.INJECTED_FAULTS`, written from outside.
    """

    def __init__(self, world: World, injected_faults: np.ndarray | None = None) -> None:
        self.world = world
        self.motors = Motors(world, injected_faults)
        """The motors; while their board is silent they get no commands, and the last measurement is repeated."""
        self.awake = False
        """Whether a command was received."""
        self.invalid_datagrams = 0
        """Datagrams that were no commands."""
        self.invalid_reason = ""
        """Reason for the last one."""
        self._measured = self.motors.measure()
        self.controller = Controller(self._measured)
        self._ticks = 0
        self._reply_due = False
        self._encoded: tuple[Fsm, JointStates] | None = None
        self._answer = b""

    def receive(self, data: bytes | memoryview) -> None:
        """Process a datagram; `reply` returns the answer."""
        self._reply_due |= self._execute(data)

    def reply(self) -> bytes | None:
        """Return the answer if a command was received since the last call: the controller answers at its own rate."""
        due, self._reply_due = self._reply_due, False
        return self.answer() if due else None

    def answer(self) -> bytes:
        """Return the controller's present answer, 208 B."""
        now = self.controller.fsm, self.controller.measured
        # Every second answer repeats the one before: encode it once.
        if self._encoded is None or now[0] is not self._encoded[0] or now[1] is not self._encoded[1]:
            self._encoded, self._answer = now, encode_state(self.controller.answer())
        return self._answer

    def handle(self, data: bytes | memoryview) -> bytes | None:
        """Process a datagram and return the answer; None when it was invalid."""
        return self.answer() if self._execute(data) else None

    def tick(self) -> None:
        """Advance the controller by 2 ms; to be called before each step of the world."""
        if self._ticks % _BOARD_TICKS == 0:
            self._exchange()
        self._ticks += 1
        self.motors.tick()

    def _execute(self, data: bytes | memoryview) -> bool:
        """Execute a datagram; return False when it was invalid and counted. Never raises."""
        try:
            self.controller.handle_command(decode_command(data))
        except ProtocolError as error:
            self.invalid_datagrams += 1
            self.invalid_reason = str(error)
            return False
        self.awake = True
        return True

    def _exchange(self) -> None:
        """Advance the controller by 4 ms, and exchange commands for measurements unless the motor board is silent."""
        connected = not self.motors.silent
        if connected:
            self._measured = self.motors.measure()
        commands = self.controller.step(self._measured, PERIOD_S)
        if connected and self.awake:
            self.motors.handle_command(commands)
