"""How the real Z1 is reached and used, and what it tells about itself."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from hal.backends.z1.client import Counts
from hal.backends.z1.faults import Fault
from hal.base.errors import InvalidValueError
from hal.z1_protocol.controller import COMMAND_PORT, STATE_PORT
from hal.z1_protocol.states import Fsm


class Z1Mode(StrEnum):
    """How the arm is commanded."""

    OBSERVE = "observe"
    """Not at all: it is only looked at."""
    TRACKING = "tracking"
    """JOINTCTRL: the controller's own position servo, with its gravity compensation."""
    LOW_LEVEL = "low_level"
    """LOWCMD: our gains, gravity and friction compensation straight to the motors."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Z1ArmConfig:
    """Where the controller is and how to use it."""

    host: str = "127.0.0.1"
    """The machine that runs `z1_ctrl`."""
    command_port: int = COMMAND_PORT
    """Its port."""
    local_host: str = "127.0.0.1"
    """The address of this machine that it answers to."""
    state_port: int = STATE_PORT
    """The port of this machine that it answers to; a second arm has another pair."""
    mode: Z1Mode = Z1Mode.TRACKING
    """What `connect` brings the arm into."""
    connect_timeout_s: float = 2.0
    """How long to wait for the first answer [s]."""

    def __post_init__(self) -> None:
        for name in ("command_port", "state_port"):
            if not 0 < getattr(self, name) < 65536:
                raise InvalidValueError(f"Z1ArmConfig.{name} is {getattr(self, name)}; allowed are 1 to 65535.")
        if not 0 < self.connect_timeout_s <= 60:
            raise InvalidValueError(f"Z1ArmConfig.connect_timeout_s is {self.connect_timeout_s}; allowed is 0 to 60 s.")
        object.__setattr__(self, "mode", Z1Mode(self.mode))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Z1Diagnostics:
    """How arm and conversation are doing."""

    fsm: Fsm
    """What the controller is doing."""
    pose: np.ndarray
    """(6,) roll, pitch, yaw [rad] and x, y, z [m] of the gripper pivot, as the controller says."""
    temperatures_c: np.ndarray
    """(8,) of the motors [°C]: joint1, both of joint2, joint3 to joint6, gripper."""
    faults: tuple[Fault, ...]
    """Every fault since the last `clear_faults`, whether it is still there or not."""
    answer_age_s: float
    """Age of the newest answer [s]."""
    unchanged_s: float
    """For how long the controller has repeated the same measurement [s]; long while moving = its board is silent."""
    counts: Counts
    """What became of the datagrams."""
    last_refusal: str
    """Why a datagram was refused last; empty when none was."""
