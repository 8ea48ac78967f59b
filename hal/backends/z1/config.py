"""Configuration and diagnostics of the real Z1's driver."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from hal.backends.z1.client import DatagramCounts
from hal.backends.z1.faults import Fault
from hal.backends.z1.requests import StateRequest
from hal.base.arm import CommandLatency
from hal.base.errors import InvalidValueError
from hal.z1_protocol.controller import COMMAND_PORT, STATE_PORT
from hal.z1_protocol.states import Fsm


class Z1Mode(StrEnum):
    """Command mode of the arm."""

    OBSERVE = "observe"
    """No commands: only measurements are read."""
    TRACKING = "tracking"
    """JOINTCTRL: the controller's own position servo, with its gravity compensation."""
    LOW_LEVEL = "low_level"
    """LOWCMD: our gains, gravity and friction compensation straight to the motors."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Z1ArmConfig:
    """Address of the controller, and the mode to use it in."""

    host: str = "127.0.0.1"
    """The machine that runs `z1_ctrl`."""
    command_port: int = COMMAND_PORT
    """Its port."""
    local_host: str = "127.0.0.1"
    """The address of this machine that it answers to."""
    state_port: int = STATE_PORT
    """The port of this machine that it answers to; a second arm has another pair."""
    mode: Z1Mode = Z1Mode.TRACKING
    """Mode after `connect`."""
    connect_timeout_s: float = 2.0
    """Timeout of the first answer [s]."""

    def __post_init__(self) -> None:
        for name in ("command_port", "state_port"):
            if not 0 < getattr(self, name) < 65536:
                raise InvalidValueError(f"Z1ArmConfig.{name} is {getattr(self, name)}; allowed are 1 to 65535.")
        if not 0 < self.connect_timeout_s <= 60:
            raise InvalidValueError(f"Z1ArmConfig.connect_timeout_s is {self.connect_timeout_s}; allowed is 0 to 60 s.")
        object.__setattr__(self, "mode", Z1Mode(self.mode))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Z1Diagnostics:
    """Health of the arm and of the connection to its controller."""

    fsm: Fsm
    """State of the controller."""
    pose: np.ndarray
    """(6,) roll, pitch, yaw [rad] and x, y, z [m] of the gripper pivot, as the controller reports."""
    temperatures_c: np.ndarray
    """(8,) of the motors [°C]: joint1, both of joint2, joint3 to joint6, gripper."""
    faults: tuple[Fault, ...]
    """Every fault since the last `clear_faults`, present or past."""
    answer_age_s: float
    """Age of the newest answer [s]."""
    unchanged_s: float
    """Duration for which the controller has repeated one measurement [s]; long while moving = its board is silent."""
    latency: CommandLatency
    """Time from a command to the answer to it, over the last half minute."""
    request: StateRequest | None
    """The last request for a state; None before the first."""
    counts: DatagramCounts
    """Datagrams by outcome."""
    invalid_reason: str
    """Reason for the last invalid datagram; empty without any."""
