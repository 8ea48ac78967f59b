"""Objects in the jaws: detection by angle and torque, and the rule that no motion drops them unasked."""

from __future__ import annotations

import math

from hal.base.errors import CommandRejectedError
from hal.base.messages import ArmState
from hal.base.z1 import N_ARM
from z1_runtime.config import RuntimeConfig

_RELAXED_RAD = 1e-3  # a goal this much more open than the command is rounding; more relaxes the grip


class GripperLoadedError(CommandRejectedError):
    """A motion that would open jaws which hold an object; nothing has moved."""

    default_code = "gripper_loaded"


def is_holding(state: ArmState, config: RuntimeConfig) -> bool:
    """Return True when something keeps the jaws from closing: open by angle, and under torque."""
    return bool(state.q[N_ARM] < config.jaw_empty and abs(state.tau[N_ARM]) > config.held_torque_nm)


def check_empty(state: ArmState, config: RuntimeConfig, task: str) -> None:
    """Check that the jaws hold nothing, before `task` opens them.

    Args:
        state: newest measurement of the arm.
        config: its thresholds `jaw_empty` and `held_torque_nm`.
        task: name of the task in the error.

    Raises:
        GripperLoadedError: they hold an object; the message has its angle and torque.
    """
    if not is_holding(state, config):
        return
    jaw, torque_nm = float(state.q[N_ARM]), float(state.tau[N_ARM])
    raise GripperLoadedError(
        f"{task}: the gripper holds an object, which opening would drop (jaws open by {abs(math.degrees(jaw)):.0f}°, "
        f"allowed up to {abs(math.degrees(config.jaw_empty)):.0f}°; torque {abs(torque_nm):.1f} Nm, allowed up to "
        f"{config.held_torque_nm:.1f} Nm). Support or put down the object, then repeat with drop=True (`./z1 run "
        f"--drop`)."
    )


def check_release(state: ArmState, jaw_command: float, jaw_goal: float, config: RuntimeConfig, task: str) -> None:
    """Check that a motion from `jaw_command` to `jaw_goal` [rad] does not relax the grip on an object.

    Raises:
        GripperLoadedError: it does.
    """
    if jaw_goal < jaw_command - _RELAXED_RAD:  # negative is open
        check_empty(state, config, task)
