"""A simulated arm behind the vendor's controller: datagrams in, datagrams out, and a tick of 2 ms for both."""

from __future__ import annotations

import numpy as np

from hal.base import z1
from hal.z1_protocol.board import PERIOD_S
from hal.z1_protocol.controller import decode_command, encode_state
from hal.z1_protocol.records import JointStates, ProtocolError
from hal.z1_protocol.states import Fsm
from sim_twin.controller.controller import Controller
from sim_twin.controller.motors import Motors
from sim_twin.model.world import World

_BOARD_TICKS = round(PERIOD_S / z1.CONTROL_PERIOD_S)


class ControlledWorld:
    """Controller and motors of one world; no sockets, no clock, no thread.

    Until the first command nothing is told to the motors, and the arm stays where it is parked. The controller works,
    and exchanges commands and measurements with the motors, at 250 Hz, so every second answer repeats the measurement.

    Args:
        world: whose arm it is; who owns it calls `tick` before each of its steps.
        ailments: a record of `sim_twin.controller.fault_injection.AILMENTS`, written into from outside.
    """

    def __init__(self, world: World, ailments: np.ndarray | None = None) -> None:
        self.world = world
        self.motors = Motors(world, ailments)
        """While their board is silent they are told nothing, and the last measurement is told."""
        self.awake = False
        """Whether a command has come."""
        self.refused = 0
        """Datagrams that were no commands."""
        self.last_refusal = ""
        """Why the last one was none."""
        self._measured = self.motors.measure()
        self.controller = Controller(self._measured)
        self._ticks = 0
        self._heard = False
        self._told: tuple[Fsm, JointStates] | None = None
        self._answer = b""

    def hear(self, data: bytes | memoryview) -> None:
        """Obey a datagram; what is answered, `tell` says."""
        self._heard |= self.take(data)

    def tell(self) -> bytes | None:
        """Return the answer if there was a command since the last time: the controller answers in its own rhythm."""
        heard, self._heard = self._heard, False
        return self.answer() if heard else None

    def take(self, data: bytes | memoryview) -> bool:
        """Obey a datagram; False when it was refused and counted. Never raises."""
        try:
            self.controller.obey(decode_command(data))
        except ProtocolError as error:
            self.refused += 1
            self.last_refusal = str(error)
            return False
        self.awake = True
        return True

    def answer(self) -> bytes:
        """Return what the controller tells now, 208 B."""
        now = self.controller.fsm, self.controller.measured
        if self._told is None or now[0] is not self._told[0] or now[1] is not self._told[1]:  # every second one repeats
            self._told, self._answer = now, encode_state(self.controller.answer())
        return self._answer

    def handle(self, data: bytes | memoryview) -> bytes | None:
        """Obey a datagram and return the answer; None when it was refused."""
        return self.answer() if self.take(data) else None

    def tick(self) -> None:
        """Let the controller work for 2 ms; to be called before each step of the world."""
        if self._ticks % _BOARD_TICKS == 0:
            self._exchange()
        self._ticks += 1
        self.motors.tick()

    def _exchange(self) -> None:
        """Let the controller do its 4 ms of work, and exchange commands for measurements if the board speaks."""
        heard = not self.motors.silent
        if heard:
            self._measured = self.motors.measure()
        told = self.controller.step(self._measured, PERIOD_S)
        if heard and self.awake:
            self.motors.obey(told)
