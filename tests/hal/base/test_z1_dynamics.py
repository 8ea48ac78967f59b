"""Feed-forward torques against the potential energy of the URDF's masses."""

from __future__ import annotations

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports] - a .pth file leads to it
import pytest

from hal.base import z1
from hal.base.z1_dynamics import FeedForward
from hal.base.z1_model import rigid_body_model

Q = np.append(z1.Q_HOME, -0.5)


def test_torques_at_rest_are_the_gradient_of_the_potential_energy() -> None:
    model, eps = rigid_body_model(), 1e-6
    data = model.createData()

    def energy(q: np.ndarray) -> float:
        return pin.computePotentialEnergy(model, data, q)

    gradient = [(energy(Q + eps * axis) - energy(Q - eps * axis)) / (2 * eps) for axis in np.eye(7)]
    assert FeedForward().torque(Q, np.zeros(7)) == pytest.approx(gradient, abs=1e-5)


def test_friction_follows_the_sign_of_the_speed() -> None:
    feed_forward = FeedForward()
    rest = feed_forward.torque(Q, np.zeros(7))
    forth, back = (feed_forward.torque(Q, np.full(7, speed)) - rest for speed in (1.0, -1.0))
    assert forth == pytest.approx(-back)
    assert (forth > 0).all()
