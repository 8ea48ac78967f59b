"""What a Z1's motors need beside their position servo in low-level mode, and no more than they may have."""

from __future__ import annotations

import numpy as np

from hal.base import z1
from hal.base.errors import InvalidMessageError
from hal.servo.limits import ServoLimits
from hal.z1_protocol.records import KD_SCALE, KP_SCALE, JointCommands, JointStates

_FRICTION_SHARE = 0.5
_FRICTION_SPEED = 0.05


class FeedForward:
    """Gravity and friction from the URDF, by pinocchio.

    Of the URDF's dry friction, round numbers that nobody identified, half is compensated: too much of it would push
    an arm that is meant to rest. It follows the commanded speed, so that no noise of a measurement drives the motors.
    """

    def __init__(self) -> None:
        import pinocchio as pin  # pyright: ignore[reportMissingImports] - a .pth file leads to it

        from hal.base.z1_model import rigid_body_model

        self._gravity = pin.computeGeneralizedGravity
        self._model = rigid_body_model()
        self._data = self._model.createData()
        self._dry = _FRICTION_SHARE * np.array(self._model.friction)
        self._viscous = np.array(self._model.damping)

    def torque(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the torques (7,) [Nm] that carry the arm at `q` (7,) [rad] and move it at `dq` (7,) [rad/s]."""
        friction = self._dry * np.tanh(dq / _FRICTION_SPEED) + self._viscous * dq
        return self._gravity(self._model, self._data, q) + friction


def limit_commands(commands: JointCommands, states: JointStates, limits: ServoLimits) -> JointCommands:
    """Return the commands nearest to `commands` under which no motor makes more torque than it may.

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
            raise InvalidMessageError(f"{name} of the motors is {getattr(commands, name)}; it must be finite.")
    tau_max = limits.tau_max.copy()
    tau_max[z1.N_ARM] = min(tau_max[z1.N_ARM], limits.grip_torque_nm)
    kp, kd = np.maximum(commands.kp, 0.0), np.maximum(commands.kd, 0.0)
    q = np.clip(commands.q, limits.q_min, limits.q_max)
    dq = np.clip(commands.dq, -limits.dq_max, limits.dq_max)
    dq[q != commands.q] = 0.0
    q, spring = _bounded(KP_SCALE * kp, q, states.q, tau_max)
    dq, damper = _bounded(KD_SCALE * kd, dq, states.dq, tau_max)
    rest = spring + damper
    tau = np.clip(commands.tau, np.maximum(-tau_max, -tau_max - rest), np.minimum(tau_max, tau_max - rest))
    return JointCommands(q=q, dq=dq, tau=tau, kp=kp, kd=kd)


def motor_torques(commands: JointCommands, states: JointStates) -> np.ndarray:
    """Return the torques (7,) [Nm] that the motors would make of `commands` at the measured `states`."""
    spring = KP_SCALE * commands.kp * (commands.q - states.q)
    return commands.tau + spring + KD_SCALE * commands.kd * (commands.dq - states.dq)


def _bounded(
    gain: np.ndarray, wish: np.ndarray, measured: np.ndarray, tau_max: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the value nearest to `wish` whose pull stays within `tau_max`, and that pull."""
    pull = gain * (wish - measured)
    allowed = np.clip(pull, -tau_max, tau_max)
    return np.where(pull == allowed, wish, measured + allowed / np.maximum(gain, 1e-9)), allowed
