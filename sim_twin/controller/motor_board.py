"""A simulated arm behind its arm board: the self-check, and for every command what the motors measure."""

from __future__ import annotations

import numpy as np

from hal.backends.z1.faults import motor_values
from hal.base import z1
from hal.z1_protocol.board import (
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

_N_MOTORS_ARM = 7


class ArmBoard:
    """Board and motors of one world; no sockets, no clock, no thread.

    As the real one it asks nobody who he is: whoever sends commands drives the motors. What it does to commands
    before a self-check was never measured; here it obeys.

    Args:
        world: whose arm it is; who owns it calls `tick` before each of its steps.
        ailments: a record of `sim_twin.controller.fault_injection.AILMENTS`, written into from outside.
        gripper: whether the gripper is connected: 8 motors and 7 records, or 7 and 6.
    """

    def __init__(self, world: World, ailments: np.ndarray | None = None, *, gripper: bool = True) -> None:
        self.world = world
        self.motors = Motors(world, ailments)
        self.refused = 0
        """Datagrams that were neither self-check nor command."""
        self.last_refusal = ""
        """Why the last one was neither."""
        self._gripper = gripper
        self._n = z1.N_JOINTS if gripper else z1.N_ARM

    def hear(self, data: bytes | memoryview) -> bytes | None:
        """Obey a datagram; return the answer, None when it was refused and counted, or while the board is dead.
        Never raises."""
        if self.motors.silent:
            return None
        if data == SELF_CHECK:
            return encode_self_check(self._self_check())
        try:
            if len(data) in COMMAND_SIZES and len(data) != COMMAND_SIZES[not self._gripper]:
                raise ProtocolError(
                    f"the command has {len(data)} bytes; of this board, with {self._n} joints, they have "
                    f"{COMMAND_SIZES[not self._gripper]}."
                )
            self.motors.obey(decode_command(data))
        except ProtocolError as error:
            self.refused += 1
            self.last_refusal = str(error)
            return None
        return encode_state(self._measure())

    def tick(self) -> None:
        """Let 2 ms pass; to be called before each step of the world."""
        self.motors.tick()

    def tell(self) -> None:
        """A board speaks when it is asked."""

    def _self_check(self) -> list[int]:
        healthy = motor_values(self.motors.link) == MotorLink.OK
        return [MOTOR_HEALTHY if well else 0 for well in healthy[: None if self._gripper else _N_MOTORS_ARM]]

    def _measure(self) -> JointStates:
        states = self.motors.measure()
        if self._gripper:
            return states
        fields = ("q", "dq", "ddq", "tau", "temperature_c", "error", "link")
        return JointStates(**{name: getattr(states, name)[: self._n] for name in fields})
