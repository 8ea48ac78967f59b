"""Packed joint records of both of the Z1's wire protocols, and their validation.

Everything is little-endian and unpadded. The sizes were measured on the vendor's own programs; a test asserts them.
Decoders accept any bytes: malformed ones raise a `ProtocolError`, which the loops count and drop.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum, IntFlag

import numpy as np

from hal.base import z1
from hal.base.errors import HalError

JOINT_CMD = np.dtype([("tau", "<f4"), ("dq", "<f4"), ("q", "<f4"), ("kp", "<f4"), ("kd", "<f4")])
"""20 B, command of a joint: torque [Nm], speed [rad/s], position [rad], gain and damping gain in wire units."""
MOTOR = np.dtype([("temperature", "i1"), ("error", "u1"), ("link", "u1")])
"""3 B, a motor's record: temperature [°C], `MotorError` bits, and `MotorLink` in the top two bits."""
JOINT_STATE = np.dtype([("tau", "<f4"), ("dq", "<f4"), ("ddq", "<f4"), ("q", "<f4"), ("motors", MOTOR, (2,))])
"""22 B, measurement of a joint and its motors: only joint 2 has a second one."""
JOINT_STATE_OLD = np.dtype([("tau", "<f4"), ("dq", "<f4"), ("ddq", "<f4"), ("q", "<f4")])
"""16 B, the same in the old format, without motor records."""

KP_SCALE = 25.6
"""Stiffness at the motor per unit of `kp` on the wire [Nm/rad] (measured on the vendor's controller)."""
KD_SCALE = 0.0128
"""Damping at the motor per unit of `kd` on the wire [Nm s/rad] (measured on the vendor's controller)."""

# Several times the capability of a Z1, so that a real but unusual measurement is never rejected.
_FIELDS = ("tau", "dq", "ddq", "q")
_PLAUSIBLE = np.array([300.0, 100.0, 1e5, 50.0])  # [Nm, rad/s, rad/s², rad]


class ProtocolError(HalError, ValueError):
    """A datagram outside the protocol; the message names the field."""

    default_code = "protocol"


class MotorError(IntFlag):
    """Error bits of a motor's record."""

    OVER_CURRENT = 0x01
    LEAKAGE = 0x02
    OVERHEAT = 0x04
    PARAMETER_JUMP = 0x20
    IGNORE = 0x40
    """Set at random by the motors; without meaning (measured on the vendor's controller)."""


class MotorLink(IntEnum):
    """Connection of a motor to the motor board."""

    OK = 0
    LOST = 1
    CRC_ERROR = 2


def _zeros() -> np.ndarray:
    return np.zeros(z1.N_JOINTS)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointCommands:
    """Commands of N joints; N is 7, or 6 without the gripper.

    A motor's torque is tau + KP_SCALE · kp · (q − q_measured) + KD_SCALE · kd · (dq − dq_measured).
    """

    q: np.ndarray = field(default_factory=_zeros)
    """(N,) positions [rad]."""
    dq: np.ndarray = field(default_factory=_zeros)
    """(N,) speeds [rad/s]."""
    tau: np.ndarray = field(default_factory=_zeros)
    """(N,) feed-forward torques [Nm]."""
    kp: np.ndarray = field(default_factory=_zeros)
    """(N,) gains in wire units, see `KP_SCALE`."""
    kd: np.ndarray = field(default_factory=_zeros)
    """(N,) damping gains in wire units, see `KD_SCALE`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointStates:
    """Measurements of N joints; N is 7, or 6 without the gripper."""

    q: np.ndarray = field(default_factory=_zeros)
    """(N,) positions [rad]."""
    dq: np.ndarray = field(default_factory=_zeros)
    """(N,) speeds [rad/s]."""
    ddq: np.ndarray = field(default_factory=_zeros)
    """(N,) accelerations [rad/s²]."""
    tau: np.ndarray = field(default_factory=_zeros)
    """(N,) torques [Nm]."""
    temperature_c: np.ndarray = field(default_factory=lambda: np.zeros((z1.N_JOINTS, 2), dtype=np.int8))
    """(N, 2) int8, motor temperatures [°C]; the second column is valid for joint 2 alone."""
    error: np.ndarray = field(default_factory=lambda: np.zeros((z1.N_JOINTS, 2), dtype=np.uint8))
    """(N, 2) uint8, `MotorError` bits."""
    link: np.ndarray = field(default_factory=lambda: np.zeros((z1.N_JOINTS, 2), dtype=np.uint8))
    """(N, 2) uint8, `MotorLink`; 3 is undocumented."""


def pack_commands(commands: JointCommands) -> np.ndarray:
    """Return records (N,) of `JOINT_CMD`.

    Raises:
        ProtocolError: a value that is not finite as a 32-bit float.
    """
    return _pack(commands, JOINT_CMD, JOINT_CMD.names or ())


def unpack_commands(records: np.ndarray) -> JointCommands:
    """Return the commands in records (N,) of `JOINT_CMD`.

    Any finite number passes: the executing side limits it.

    Raises:
        ProtocolError: a value that is not finite.
    """
    floats = records.view("<f4").reshape(-1, 5)
    if not np.isfinite(floats).all():
        raise _not_finite(records, ("tau", "dq", "q", "kp", "kd"))
    tau, dq, q, kp, kd = floats.astype(np.float64).T
    return JointCommands(q=q, dq=dq, tau=tau, kp=kp, kd=kd)


def pack_states(states: JointStates) -> np.ndarray:
    """Return records (N,) of `JOINT_STATE`.

    Raises:
        ProtocolError: a value that is not finite as a 32-bit float.
    """
    records = _pack(states, JOINT_STATE, ("tau", "dq", "ddq", "q"))
    motors = records["motors"]
    motors["temperature"] = states.temperature_c
    motors["error"] = states.error
    motors["link"] = states.link.astype(np.uint8) << 6
    return records


def unpack_states(records: np.ndarray) -> JointStates:
    """Return the states in records (N,) of `JOINT_STATE`, or of `JOINT_STATE_OLD` with motors that report nothing.

    Raises:
        ProtocolError: a value that is not finite, or that no Z1 can have.
    """
    # Through the bytes: reading a structured array costs several times as much, 500 times a second.
    raw = records.view(np.uint8).reshape(len(records), -1)
    floats = np.ascontiguousarray(raw[:, : JOINT_STATE_OLD.itemsize]).view("<f4")
    if not (np.abs(floats) <= _PLAUSIBLE).all():  # false for a NaN, too
        raise _not_plausible(floats)
    tau, dq, ddq, q = floats.astype(np.float64).T
    motors = raw[:, JOINT_STATE_OLD.itemsize :] if records.dtype == JOINT_STATE else np.zeros((len(raw), 6), np.uint8)
    motors = motors.reshape(-1, 2, MOTOR.itemsize)
    temperature_c, error, link = motors[..., 0].view(np.int8), motors[..., 1], motors[..., 2] >> 6
    return JointStates(q=q, dq=dq, ddq=ddq, tau=tau, temperature_c=temperature_c, error=error, link=link)


def _pack(values: JointCommands | JointStates, dtype: np.dtype, names: tuple[str, ...]) -> np.ndarray:
    records = np.zeros(len(values.q), dtype=dtype)
    with np.errstate(over="ignore", invalid="ignore"):  # the check below names the joint, which a warning would not
        for name in names:
            records[name] = getattr(values, name)
    for name in names:
        if not np.isfinite(records[name]).all():
            raise _not_finite(records, names)
    return records


def _not_finite(records: np.ndarray, names: tuple[str, ...]) -> ProtocolError:
    name = next(name for name in names if not np.isfinite(records[name]).all())
    joint = int(np.argmin(np.isfinite(records[name])))
    return ProtocolError(
        f"{name} of {z1.JOINT_NAMES[joint]} is {records[name][joint]}; it must be finite.", code="not_finite"
    )


def _not_plausible(values: np.ndarray) -> ProtocolError:
    joint, column = divmod(int(np.argmin(np.abs(values) <= _PLAUSIBLE)), len(_FIELDS))
    return ProtocolError(
        f"{_FIELDS[column]} of {z1.JOINT_NAMES[joint]} is {values[joint, column]}; a Z1 measures at most "
        f"±{_PLAUSIBLE[column]:g} (SI units).",
        code="implausible_value",
    )
