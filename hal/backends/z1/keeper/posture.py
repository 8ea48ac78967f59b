"""Present posture of the arm as motor commands: the body of every datagram that requests no motion."""

from __future__ import annotations

import numpy as np

from hal.base import z1
from hal.z1_protocol.controller import KD_JOINTCTRL, KP_JOINTCTRL
from hal.z1_protocol.records import JointCommands, JointStates

# A command further from the measurement than this is no posture of the arm, but one that it is kept from [rad].
_HELD_RAD = 0.05
# Friction keeps a free jaw within this torque [Nm]; more is the grip on an object.
_FREE_JAW_NM = 0.3
_GRIPPER = z1.N_ARM


def compute_posture(measured: JointStates, q_command: np.ndarray | None, kp: np.ndarray | None) -> JointCommands:
    """Return the present posture as motor commands that go on as JOINTCTRL would: its gains, and the torques now.

    Of the arm's joints it is the position commanded, where the arm is close to it, and else the measured one; the jaw's
    is ahead of the measurement by as much as its torque needs, so that it keeps its grip.

    Args:
        measured: the newest measurement.
        q_command: (7,) positions commanded last [rad]; None = unknown.
        kp: (7,) gains of that command, in wire units; where 0, its position means nothing.
    """
    q = measured.q.copy()
    if q_command is not None and kp is not None:
        held = (kp > 0.0) & (np.abs(q_command - q) < _HELD_RAD)
        held[_GRIPPER] = False
        q[held] = q_command[held]
    tau = np.clip(measured.tau, -z1.TAU_MAX, z1.TAU_MAX)
    grip_nm = float(tau[_GRIPPER])
    if abs(grip_nm) > _FREE_JAW_NM:
        q[_GRIPPER] += grip_nm / z1.KP[_GRIPPER]
    tau[_GRIPPER] = 0.0
    return JointCommands(q=np.clip(q, z1.Q_MIN, z1.Q_MAX), tau=tau, kp=KP_JOINTCTRL, kd=KD_JOINTCTRL)
