"""A simulated arm behind the vendor's controller: datagrams in, datagrams out, and a tick of 2 ms for both."""

from __future__ import annotations

import numpy as np

from hal.base import z1
from hal.z1_protocol.controller import encode_state
from hal.z1_protocol.motor_board import PERIOD_S
from sim_twin.controller.client_port import ClientPort
from sim_twin.controller.controller import Controller
from sim_twin.controller.motors import Motors
from sim_twin.model.world import World

_BOARD_TICKS = round(PERIOD_S / z1.CONTROL_PERIOD_S)


class ControlledWorld:
    """Controller and motors of one world; no sockets, no clock, no thread.

    Until the first command the motors get none, and the arm stays parked. The controller's two threads run at their
    own rates: one exchanges datagrams with the client every 2.035 ms at most, the other runs the state machine and
    exchanges commands and measurements with the motors at 250 Hz, so about every second answer repeats the one before.

    Args:
        world: world of the arm; its owner calls `tick` before each of its steps.
        injected_faults: a record of `sim_twin.controller.fault_injection.INJECTED_FAULTS`, written from outside.
    """

    def __init__(self, world: World, injected_faults: np.ndarray | None = None) -> None:
        self.world = world
        self.motors = Motors(world, injected_faults)
        """The motors; while their board is silent they get no commands, and the last measurement is repeated."""
        self.port = ClientPort()
        """Queue of the client's datagrams."""
        self._measured = self.motors.measure()
        self.controller = Controller(self._measured)
        self._ticks = 0
        self._answer = encode_state(self.controller.answer())
        self._due: bytes | None = None

    @property
    def invalid_datagrams(self) -> int:
        """Datagrams that were no commands, and commands whose body did not fit the state."""
        return self.port.invalid_datagrams + self.controller.invalid_bodies

    @property
    def invalid_reason(self) -> str:
        """Reason for the last invalid datagram."""
        return self.controller.invalid_reason or self.port.invalid_reason

    @property
    def answer(self) -> bytes:
        """The answer (208 B) of the next cycle."""
        return self._answer

    def receive(self, data: bytes | memoryview) -> None:
        """Queue a datagram, which the controller reads in one of its next cycles; a full queue drops it."""
        self.port.receive(data)

    def reply(self) -> bytes | None:
        """Return the answer (208 B) that became due in the last tick, if any."""
        due, self._due = self._due, None
        return due

    def tick(self) -> None:
        """Advance the controller by 2 ms; to be called before each step of the world."""
        if self.port.advance(self._ticks * z1.CONTROL_PERIOD_S):
            self._due = self._answer
        if self._ticks % _BOARD_TICKS == 0:
            self._exchange()
        self._ticks += 1
        self.motors.tick()

    def _exchange(self) -> None:
        """Advance the controller by 4 ms, and exchange commands for measurements unless the motor board is silent."""
        connected = not self.motors.silent
        if connected:
            self._measured = self.motors.measure()
        commands = self.controller.step(self.port.command, self._measured, PERIOD_S)
        if connected and self.port.connected:
            self.motors.handle_command(commands)
        self._answer = encode_state(self.controller.answer())
