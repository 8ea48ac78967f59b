"""A simulated arm behind the vendor's controller: datagrams in, datagrams out, and a tick of 2 ms for both."""

from __future__ import annotations

import numpy as np

from hal import z1
from hal.wire.board import PERIOD_S
from hal.wire.controller import decode_command, encode_state
from hal.wire.records import KD_SCALE, KP_SCALE, JointStates, WireError
from sim_twin.controller import Controller
from sim_twin.world import World

TEMPERATURE_C = 30
"""Of every motor, as long as nobody sets another [°C]."""

_BOARD_TICKS = round(PERIOD_S / z1.CONTROL_PERIOD_S)


class ControlledWorld:
    """Controller and motors of one world; no sockets, no clock, no thread.

    Until the first command nothing is told to the motors, and the arm stays where it is parked. Commands and
    measurements pass between controller and motors at 250 Hz, so every second answer repeats the measurement.

    Args:
        world: whose arm it is; who owns it calls `tick` before each of its steps.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        shape = (z1.N_JOINTS, 2)
        self.error = np.zeros(shape, dtype=np.uint8)
        """(7, 2) `MotorError` bits; set them to break a motor."""
        self.link = np.zeros(shape, dtype=np.uint8)
        """(7, 2) `MotorLink`; the same."""
        self.temperature_c = np.full(shape, TEMPERATURE_C, dtype=np.int8)
        """(7, 2) [°C]."""
        self.board_silent = False
        """While it is set the motors keep their last command, and the last measurement is told."""
        self.awake = False
        """Whether a command has come."""
        self.refused = 0
        """Datagrams that were no commands."""
        self.last_refusal = ""
        """Why the last one was none."""
        self._dq = np.zeros(z1.N_JOINTS)
        self._measured = self._measure()
        self.controller = Controller(self._measured)
        self._ticks = 0

    def take(self, data: bytes | memoryview) -> bool:
        """Obey a datagram; False when it was refused and counted. Never raises."""
        try:
            self.controller.obey(decode_command(data))
        except WireError as error:
            self.refused += 1
            self.last_refusal = str(error)
            return False
        self.awake = True
        return True

    def answer(self) -> bytes:
        """Return what the controller tells now, 208 B."""
        return encode_state(self.controller.answer())

    def handle(self, data: bytes | memoryview) -> bytes | None:
        """Obey a datagram and return the answer; None when it was refused."""
        return self.answer() if self.take(data) else None

    def tick(self) -> None:
        """Let the controller work for 2 ms; to be called before each step of the world."""
        exchange = self._ticks % _BOARD_TICKS == 0 and not self.board_silent
        self._ticks += 1
        if exchange:
            self._measured = self._measure()
        told = self.controller.step(self._measured, z1.CONTROL_PERIOD_S)
        if exchange and self.awake:
            self.world.set_motors(told.q, told.dq, told.tau, KP_SCALE * told.kp, KD_SCALE * told.kd)

    def _measure(self) -> JointStates:
        q, dq, tau = self.world.read_arm()
        ddq, self._dq = (dq - self._dq) / PERIOD_S, dq
        return JointStates(
            q=q,
            dq=dq,
            ddq=ddq,
            tau=tau,
            temperature_c=self.temperature_c.copy(),
            error=self.error.copy(),
            link=self.link.copy(),
        )
