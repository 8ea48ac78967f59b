"""Motor fault decoding and latching."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.base import z1
from hal.z1_protocol.records import JointStates, MotorError, MotorLink

REPORT_S = 0.5
"""A fault is reported for this long after its last occurrence [s], so that a client polling at 2 Hz gets every one."""

_DOUBLE = 1  # joint2 has two motors
_SINGLE = [joint for joint in range(z1.N_JOINTS) if joint != _DOUBLE]
_MOTOR_AT = [2 * joint for joint in range(z1.N_JOINTS)]
_MOTOR_AT.insert(_DOUBLE + 1, 2 * _DOUBLE + 1)
# The motor electronics report every single datagram lost on their bus: one is no fault, ten (20 ms) are.
_ERROR_COUNT = 2
_LINK_COUNT = 10
_IGNORED = int(MotorError.IGNORE)
_ERROR_NAMES = {
    int(MotorError.OVER_CURRENT): "over-current",
    int(MotorError.LEAKAGE): "leakage current",
    int(MotorError.OVERHEAT): "overheat",
    int(MotorError.PARAMETER_JUMP): "parameter jump",
}
_LINK_NAMES = {int(MotorLink.LOST): "motor lost", int(MotorLink.CRC_ERROR): "CRC errors"}


class Fault(NamedTuple):
    """One fault and the times at which it occurred."""

    text: str
    """For instance "joint2 motor 2: overheat"."""
    first_s: float
    """First occurrence [s]."""
    last_s: float
    """Last occurrence [s]."""


class FaultLatch:
    """Faults decoded from motor records, kept until they are cleared.

    An error bit counts when two measurements in a row have it, a lost or garbled motor after ten (20 ms).
    """

    def __init__(self) -> None:
        shape = (z1.N_JOINTS, 2)
        self._error_counts = np.zeros((*shape, 8), dtype=np.int32)
        self._link_counts = np.zeros(shape, dtype=np.int32)
        self._faults: dict[str, Fault] = {}

    def update(self, joints: JointStates, now_s: float) -> None:
        """Evaluate a measurement of `now_s` [s]."""
        error, link = joints.error & ~np.uint8(_IGNORED), joints.link.copy()
        error[_SINGLE, 1] = link[_SINGLE, 1] = 0  # only joint 2 has a second motor
        if not (error.any() or link.any()):
            if self._error_counts.any() or self._link_counts.any():
                self._error_counts[:] = 0
                self._link_counts[:] = 0
            return
        bits = np.unpackbits(error[..., None], axis=-1, bitorder="little")
        self._error_counts = (self._error_counts + 1) * bits
        self._link_counts = (self._link_counts + 1) * (link != 0)
        for joint, motor, bit in np.argwhere(self._error_counts >= _ERROR_COUNT):
            name = _ERROR_NAMES.get(1 << int(bit), f"unknown error 0x{1 << int(bit):02x}")
            self.add(f"{_motor_name(joint, motor)}: {name}", now_s)
        for joint, motor in np.argwhere(self._link_counts >= _LINK_COUNT):
            state = int(link[joint, motor])
            self.add(f"{_motor_name(joint, motor)}: {_LINK_NAMES.get(state, f'unknown link state {state}')}", now_s)

    def add(self, text: str, now_s: float) -> None:
        """Latch a fault that occurs at `now_s` [s]."""
        first_s = self._faults[text].first_s if text in self._faults else now_s
        self._faults[text] = Fault(text, first_s, now_s)

    def active(self, now_s: float) -> tuple[str, ...]:
        """Return the texts of the faults present at `now_s` [s], or until `REPORT_S` before."""
        if not self._faults:
            return ()
        return tuple(fault.text for fault in self._faults.values() if now_s - fault.last_s <= REPORT_S)

    def latched(self) -> tuple[Fault, ...]:
        """Return every fault since the last `clear`, oldest first."""
        return tuple(sorted(self._faults.values(), key=lambda fault: fault.first_s))

    def clear(self) -> None:
        """Clear the latch; faults that persist are latched again."""
        self._faults.clear()


def motor_values(values: np.ndarray) -> np.ndarray:
    """Return, of `values` (7, 2), those (8,) of joint1, joint2's two motors, joint3 … joint6 and the gripper."""
    return values.ravel()[_MOTOR_AT]


def _motor_name(joint: int, motor: int) -> str:
    name = z1.JOINT_NAMES[joint]
    return f"{name} motor {motor + 1}" if joint == _DOUBLE else name
