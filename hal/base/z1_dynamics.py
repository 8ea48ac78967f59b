"""Feed-forward torques of the Z1: gravity and friction from its URDF, by pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports] - a .pth file leads to it

from hal.base.z1_model import rigid_body_model

# The URDF's dry friction is a round number that was never identified: compensating all of it would push a resting arm.
_FRICTION_RATIO = 0.5
# Width of the sign change of dry friction [rad/s]; a smooth one does not chatter around zero speed.
_FRICTION_SPEED = 0.05


class FeedForward:
    """Gravity and friction torques; one object belongs to one thread, as its scratch memory does.

    Half of the URDF's dry friction is compensated. It follows the commanded speed, so that measurement noise does not
    drive the motors.
    """

    def __init__(self) -> None:
        self._model = rigid_body_model()
        self._data = self._model.createData()
        self._dry = _FRICTION_RATIO * np.array(self._model.friction)
        self._viscous = np.array(self._model.damping)

    def torque(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the torques (7,) [Nm] that carry the arm at `q` (7,) [rad] and move it at `dq` (7,) [rad/s]."""
        friction = self._dry * np.tanh(dq / _FRICTION_SPEED) + self._viscous * dq
        return pin.computeGeneralizedGravity(self._model, self._data, q) + friction
