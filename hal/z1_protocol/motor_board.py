"""Protocol of z1_ctrl ↔ motor board: self-check, then commands of 140 B to port 8880, states of 154 B to port 8881.

Without the gripper there are six records instead of seven, and both sizes shrink accordingly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hal.base import z1
from hal.z1_protocol.records import (
    JOINT_CMD,
    JOINT_STATE,
    JOINT_STATE_OLD,
    JointCommands,
    JointStates,
    ProtocolError,
    pack_commands,
    pack_states,
    unpack_commands,
    unpack_states,
)

BOARD_PORT = 8880
"""Bound by the board."""
CONTROLLER_PORT = 8881
"""Bound by the controller."""
BOARD_ADDRESS = "192.168.123.110"
"""Address of the real board."""
PERIOD_S = 0.004
"""Period of the controller's commands [s]; the mean measured on the vendor's controller is 4.04 ms."""
SELF_CHECK = b"\x02"
"""Request that the controller sends every 0.2 s until the board answers with `encode_self_check`."""
CALIBRATION = b"\x01"
"""Request that makes the present pose the zero; the controller waits two seconds for the answer."""
CALIBRATION_DONE = b"\x10"
"""Answer to `CALIBRATION` that the vendor's controller takes for success; it takes others, or none, for a failure."""
COMMAND_SIZES = tuple(n * JOINT_CMD.itemsize for n in (z1.N_JOINTS, z1.N_ARM))
"""140 B, and 120 B without gripper."""
STATE_SIZES = tuple(n * JOINT_STATE.itemsize for n in (z1.N_JOINTS, z1.N_ARM))
"""154 B, and 132 B without gripper."""
OLD_STATE_SIZES = tuple(n * JOINT_STATE_OLD.itemsize for n in (z1.N_JOINTS, z1.N_ARM))
"""112 B and 96 B: boards that send no motor records."""
MOTORS = (8, 7)
"""Motors with and without gripper; joint 2 has two."""
MOTOR_HEALTHY = 1
"""A motor's byte in the self-check."""

_SELF_CHECK_ANSWER = 0x20  # followed by the number of motors and one byte each (measured)


def encode_self_check(motors: Sequence[int]) -> bytes:
    """Return the board's answer to `SELF_CHECK`: one byte a motor, `MOTOR_HEALTHY` without a fault."""
    return bytes((_SELF_CHECK_ANSWER, len(motors), *motors))


def decode_self_check(data: bytes | memoryview) -> tuple[int, ...]:
    """Return the byte of each motor.

    Raises:
        ProtocolError: not the answer to a self-check.
    """
    if len(data) < 2 or data[0] != _SELF_CHECK_ANSWER or data[1] not in MOTORS or len(data) != 2 + data[1]:
        raise ProtocolError(
            f"the answer to the self-check is {bytes(data[:12]).hex()} ({len(data)} bytes); allowed is 20, the number "
            f"of motors ({MOTORS[1]} or {MOTORS[0]}) and a byte for each.",
            code="self_check",
        )
    return tuple(data[2:])


def encode_command(commands: JointCommands) -> bytes:
    """Return a command of 140 B (120 B for six joints).

    Raises:
        ProtocolError: a value that is not finite.
    """
    return pack_commands(commands).tobytes()


def decode_command(data: bytes | memoryview) -> JointCommands:
    """Return the command in a datagram.

    Raises:
        ProtocolError: wrong size, or a value that is not finite.
    """
    if len(data) not in COMMAND_SIZES:
        raise ProtocolError(
            f"the motor board's command has {len(data)} bytes; allowed are {COMMAND_SIZES}.", code="wrong_size"
        )
    return unpack_commands(np.frombuffer(bytes(data), JOINT_CMD))


def encode_state(states: JointStates) -> bytes:
    """Return a state of 154 B (132 B for six joints).

    Raises:
        ProtocolError: a value that is not finite.
    """
    return pack_states(states).tobytes()


def decode_state(data: bytes | memoryview) -> JointStates:
    """Return the state in a datagram; the old format without motor records is accepted.

    Raises:
        ProtocolError: wrong size, or a value that no Z1 can have.
    """
    if len(data) in STATE_SIZES:
        return unpack_states(np.frombuffer(bytes(data), JOINT_STATE))
    if len(data) in OLD_STATE_SIZES:  # the vendor's controller accepts it, too (measured)
        return unpack_states(np.frombuffer(bytes(data), JOINT_STATE_OLD))
    raise ProtocolError(
        f"the motor board's state has {len(data)} bytes; allowed are {STATE_SIZES + OLD_STATE_SIZES}.",
        code="wrong_size",
    )
