"""What a Z1's motors complain about: in words, for as long as it lasts, and remembered until somebody looks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.base import z1
from hal.z1_protocol.records import JointStates, MotorError, MotorLink

SHOWN_S = 0.5
"""A fault is reported until so long after it was last seen [s]: nobody who looks now and then misses it."""

_DOUBLE = 1
_SINGLE = [joint for joint in range(z1.N_JOINTS) if joint != _DOUBLE]
_MOTOR_AT = [2 * joint for joint in range(z1.N_JOINTS)]
_MOTOR_AT.insert(_DOUBLE + 1, 2 * _DOUBLE + 1)
_ERROR_TIMES = 2
_LINK_TIMES = 10
_IGNORED = int(MotorError.IGNORE)
_ERROR_WORDS = {
    int(MotorError.OVER_CURRENT): "over-current",
    int(MotorError.LEAKAGE): "leakage current",
    int(MotorError.OVERHEAT): "overheat",
    int(MotorError.PARAMETER_JUMP): "parameter jump",
}
_LINK_WORDS = {int(MotorLink.LOST): "motor lost", int(MotorLink.CRC_ERROR): "CRC errors"}


class Fault(NamedTuple):
    """A fault that was seen."""

    words: str
    """For instance "joint2 motor 2: overheat"."""
    first_s: float
    """When it was first seen [s]."""
    last_s: float
    """When it was last seen [s]."""


class FaultLatch:
    """Turns motor records into faults and keeps them.

    An error bit counts when two measurements in a row have it, a lost or garbled motor after ten (20 ms): the arm
    board reports every single datagram that it missed on its bus.
    """

    def __init__(self) -> None:
        shape = (z1.N_JOINTS, 2)
        self._error_times = np.zeros((*shape, 8), dtype=np.int32)
        self._link_times = np.zeros(shape, dtype=np.int32)
        self._seen: dict[str, Fault] = {}

    def update(self, joints: JointStates, now_s: float) -> None:
        """Take a measurement of `now_s` [s]."""
        error, link = joints.error & ~np.uint8(_IGNORED), joints.link.copy()
        error[_SINGLE, 1] = link[_SINGLE, 1] = 0  # only joint 2 has a second motor
        if not (error.any() or link.any()):
            if self._error_times.any() or self._link_times.any():
                self._error_times[:] = 0
                self._link_times[:] = 0
            return
        bits = np.unpackbits(error[..., None], axis=-1, bitorder="little")
        self._error_times = (self._error_times + 1) * bits
        self._link_times = (self._link_times + 1) * (link != 0)
        for joint, motor, bit in np.argwhere(self._error_times >= _ERROR_TIMES):
            word = _ERROR_WORDS.get(1 << int(bit), f"unknown error 0x{1 << int(bit):02x}")
            self.note(f"{_name(joint, motor)}: {word}", now_s)
        for joint, motor in np.argwhere(self._link_times >= _LINK_TIMES):
            state = int(link[joint, motor])
            self.note(f"{_name(joint, motor)}: {_LINK_WORDS.get(state, f'unknown link state {state}')}", now_s)

    def note(self, words: str, now_s: float) -> None:
        """Take a fault of another kind, seen at `now_s` [s]."""
        first_s = self._seen[words].first_s if words in self._seen else now_s
        self._seen[words] = Fault(words, first_s, now_s)

    def shown(self, now_s: float) -> tuple[str, ...]:
        """Return the faults present at `now_s` [s], or until `SHOWN_S` ago, in words."""
        if not self._seen:
            return ()
        return tuple(fault.words for fault in self._seen.values() if now_s - fault.last_s <= SHOWN_S)

    def latched(self) -> tuple[Fault, ...]:
        """Return every fault since the last `clear`, oldest first."""
        return tuple(sorted(self._seen.values(), key=lambda fault: fault.first_s))

    def clear(self) -> None:
        """Forget what was seen; what is still there is seen again."""
        self._seen.clear()


def motor_values(values: np.ndarray) -> np.ndarray:
    """Return, of `values` (7, 2), those (8,) of joint1, joint2's two motors, joint3 … joint6 and the gripper."""
    return values.ravel()[_MOTOR_AT]


def _name(joint: int, motor: int) -> str:
    name = z1.JOINT_NAMES[joint]
    return f"{name} motor {motor + 1}" if joint == _DOUBLE else name
