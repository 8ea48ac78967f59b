"""The rigid-body model that all packages share, against the URDF and its own derivatives."""

import numpy as np
import pytest

from hal.base import z1
from hal.base.z1_model import ForwardKinematics, joint_placements, rigid_body_model

KINEMATICS = ForwardKinematics()


def test_the_model_is_parsed_once() -> None:
    assert rigid_body_model() is rigid_body_model()


def test_joint_limits_are_those_of_the_urdf() -> None:
    model = rigid_body_model()
    np.testing.assert_allclose(model.lowerPositionLimit, z1.Q_MIN, atol=1e-3)
    np.testing.assert_allclose(model.upperPositionLimit, z1.Q_MAX, atol=1e-3)


def test_the_chain_of_joint_placements_leads_to_the_flange() -> None:
    placements, axes = joint_placements()
    q = np.array([0.3, 1.1, -0.9, 0.2, -0.4, 0.7])
    T = np.eye(4)
    for placement, axis, angle in zip(placements, axes, q, strict=True):
        turn = np.eye(4)
        i, j = [k for k in range(3) if k != "XYZ".index(axis)]
        sign = -1.0 if axis == "Y" else 1.0
        turn[i, i] = turn[j, j] = np.cos(angle)
        turn[j, i], turn[i, j] = sign * np.sin(angle), -sign * np.sin(angle)
        T = T @ placement @ turn
    np.testing.assert_allclose(T, KINEMATICS.link_poses(np.append(q, 0.0))["link06"], atol=1e-12)
    np.testing.assert_allclose(KINEMATICS.flange(q), T, atol=1e-12)


def test_the_pivot_sits_on_the_flange() -> None:
    np.testing.assert_allclose(
        KINEMATICS.pivot(z1.Q_HOME), KINEMATICS.flange(z1.Q_HOME) @ z1.T_FLANGE_PIVOT, atol=1e-12
    )


@pytest.mark.parametrize("joint", range(6))
def test_the_jacobian_is_the_derivative_of_the_pivot(joint: int) -> None:
    step = np.zeros(6)
    step[joint] = 1e-6
    numeric = (KINEMATICS.pivot(z1.Q_HOME + step) - KINEMATICS.pivot(z1.Q_HOME - step))[:3, 3] / 2e-6
    np.testing.assert_allclose(KINEMATICS.jacobian(z1.Q_HOME)[:3, joint], numeric, atol=1e-7)
