"""A simulated arm behind its motor board: self-check, calibration, and a measurement as the answer to a command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hal.backends.z1.faults import motor_values
from hal.base import z1
from hal.z1_protocol.motor_board import (
    CALIBRATION,
    CALIBRATION_DONE,
    COMMAND_SIZES,
    MOTOR_HEALTHY,
    SELF_CHECK,
    decode_command,
    encode_self_check,
    encode_state,
)
from hal.z1_protocol.records import JointStates, MotorLink, ProtocolError
from sim_twin.controller.motors import Motors
from sim_twin.model.world import World

# Joint 2 has two motors
_N_MOTORS_ARM = 7


class MotorBoard:
    """Motor board and motors of one world; no sockets, no clock, no thread.

    As the real one it has no access control: commands of any sender drive the motors. The real board's treatment of
    commands before a self-check was never measured; this one executes them.

    Args:
        world: world of the arm; its owner calls `tick` before each of its steps.
        injected_faults: a record of `sim_twin.controller.fault_injection.INJECTED_FAULTS`, written from outside.
        gripper: whether the gripper is connected: 8 motors and 7 records, or 7 and 6.
    """

    def __init__(self, world: World, injected_faults: np.ndarray | None = None, *, gripper: bool = True) -> None:
        self.world = world
        self.motors = Motors(world, injected_faults)
        self.invalid_datagrams = 0
        """Datagrams that were neither self-check nor calibration nor command."""
        self.invalid_reason = ""
        """Reason for the last one."""
        self._gripper = gripper
        self._n = z1.N_JOINTS if gripper else z1.N_ARM
        self._zero = np.zeros(z1.N_JOINTS)  # set by a calibration, of the arm alone

    def receive(self, data: bytes | memoryview) -> bytes | None:
        """Process a datagram; return the answer, None when it was invalid or the board is silent. Never raises."""
        if self.motors.silent:
            return None
        if data == SELF_CHECK:
            return encode_self_check(self._self_check())
        if data == CALIBRATION:
            self._zero[: z1.N_ARM] = self.motors.measure().q[: z1.N_ARM]
            return CALIBRATION_DONE
        try:
            if len(data) in COMMAND_SIZES and len(data) != COMMAND_SIZES[not self._gripper]:
                raise ProtocolError(
                    f"the command has {len(data)} bytes; allowed with {self._n} joints are "
                    f"{COMMAND_SIZES[not self._gripper]}.",
                    code="wrong_size",
                )
            commands = decode_command(data)
            self.motors.handle_command(replace(commands, q=commands.q + self._zero[: self._n]))
        except ProtocolError as error:
            self.invalid_datagrams += 1
            self.invalid_reason = str(error)
            return None
        return encode_state(self._measure())

    def tick(self) -> None:
        """Advance by 2 ms; to be called before each step of the world."""
        self.motors.tick()

    def reply(self) -> None:
        """Return nothing: a motor board answers in `receive` only."""

    def _self_check(self) -> list[int]:
        healthy = motor_values(self.motors.link) == MotorLink.OK
        return [MOTOR_HEALTHY if ok else 0 for ok in healthy[: None if self._gripper else _N_MOTORS_ARM]]

    def _measure(self) -> JointStates:
        states = self.motors.measure()
        states = replace(states, q=states.q - self._zero)
        if self._gripper:
            return states
        fields = ("q", "dq", "ddq", "tau", "temperature_c", "error", "link")
        return JointStates(**{name: getattr(states, name)[: self._n] for name in fields})
