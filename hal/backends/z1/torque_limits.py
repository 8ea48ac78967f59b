"""Torque limits of the Z1's motors in low-level mode, where the vendor's controller has none."""

from __future__ import annotations

import numpy as np

from hal.base import z1
from hal.base.errors import InvalidMessageError
from hal.servo.limits import ServoLimits
from hal.z1_protocol.records import KD_SCALE, KP_SCALE, JointCommands, JointStates


def limit_commands(commands: JointCommands, states: JointStates, limits: ServoLimits) -> JointCommands:
    """Return the commands nearest to `commands` under which no motor exceeds its torque limit.

    Positions stay within the joint limits and speeds within theirs. Of the torque that a motor would make of a
    command at the measured state, spring and damper are each kept within the limit by moving their set values, and
    the feed-forward torque then keeps their sum within it. The gripper's limit is its grip torque.

    Args:
        commands: (7,) each.
        states: the newest measurement.
        limits: the limits.

    Raises:
        InvalidMessageError: values that are not finite.
    """
    for name in ("q", "dq", "tau", "kp", "kd"):
        if not np.isfinite(getattr(commands, name)).all():
            raise InvalidMessageError(f"Z1: motor {name} is {getattr(commands, name)}; it must be finite.")
    tau_max = limits.tau_max.copy()
    tau_max[z1.N_ARM] = min(tau_max[z1.N_ARM], limits.grip_torque_nm)
    kp, kd = np.maximum(commands.kp, 0.0), np.maximum(commands.kd, 0.0)  # a negative gain would amplify each deviation
    q = np.clip(commands.q, limits.q_min, limits.q_max)
    dq = np.clip(commands.dq, -limits.dq_max, limits.dq_max)
    dq[q != commands.q] = 0.0  # at a joint limit the speed would only push into it
    q, spring = _limit_torque(KP_SCALE * kp, q, states.q, tau_max)
    dq, damper = _limit_torque(KD_SCALE * kd, dq, states.dq, tau_max)
    rest = spring + damper
    tau = np.clip(commands.tau, np.maximum(-tau_max, -tau_max - rest), np.minimum(tau_max, tau_max - rest))
    return JointCommands(q=q, dq=dq, tau=tau, kp=kp, kd=kd)


def motor_torques(commands: JointCommands, states: JointStates) -> np.ndarray:
    """Return the torques (7,) [Nm] that the motors would make of `commands` at the measured `states`."""
    spring = KP_SCALE * commands.kp * (commands.q - states.q)
    return commands.tau + spring + KD_SCALE * commands.kd * (commands.dq - states.dq)


def _limit_torque(
    gain: np.ndarray, desired: np.ndarray, measured: np.ndarray, tau_max: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the value nearest to `desired` whose torque stays within `tau_max`, and that torque."""
    torque = gain * (desired - measured)
    allowed = np.clip(torque, -tau_max, tau_max)
    # The minimum gain only avoids 0 / 0; without a gain the torque is 0 and `desired` is kept.
    return np.where(torque == allowed, desired, measured + allowed / np.maximum(gain, 1e-9)), allowed
