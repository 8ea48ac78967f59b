"""The vendor's model of the arm, on our kinematics and dynamics."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base import z1
from hal.compat.unitree_arm_interface.model import Z1Model, homoToPosture, postureToHomo
from hal.z1_protocol.controller import LABELS

REST = np.zeros(6)
FORWARD = LABELS["forward"]


@pytest.fixture(scope="module")
def model() -> Z1Model:
    return Z1Model.with_gripper()


def random_q(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(z1.Q_MIN[:6], z1.Q_MAX[:6])


def test_the_end_effector_is_where_the_controller_reports_it(model: Z1Model) -> None:
    posture = homoToPosture(model.forwardKinematics(FORWARD, 6))
    assert posture == pytest.approx([0, -0.040, 0, 0.4129, 0, 0.4069], abs=1e-4)


def test_the_first_joints_are_where_the_urdf_has_them(model: Z1Model) -> None:
    assert model.forwardKinematics(FORWARD, 0)[:3, 3] == pytest.approx([0, 0, 0.0585])
    assert model.forwardKinematics(FORWARD, 1)[:3, 3] == pytest.approx([0, 0, 0.1035])
    with pytest.raises(ValueError):
        model.forwardKinematics(FORWARD, 7)


@pytest.mark.parametrize("seed", range(5))
def test_postures_and_poses_are_the_same(seed: int) -> None:
    posture = np.random.default_rng(seed).uniform(-1.5, 1.5, 6)
    assert homoToPosture(postureToHomo(posture)) == pytest.approx(posture)


def test_the_order_of_the_angles_is_the_vendors() -> None:
    T = postureToHomo([0.1, 0.2, 0.3, 1, 2, 3])
    x, y, z = (np.array(axis, dtype=float) for axis in np.eye(3))
    assert T[:3, :3] @ x == pytest.approx([np.cos(0.3) * np.cos(0.2), np.sin(0.3) * np.cos(0.2), -np.sin(0.2)])
    assert (T[:3, :3] @ y)[2] == pytest.approx(np.cos(0.2) * np.sin(0.1))
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert (T @ [*z, 1])[:3] - T[:3, 2] == pytest.approx([1, 2, 3])


@pytest.mark.parametrize("seed", range(5))
def test_joints_are_found_for_reachable_poses(model: Z1Model, seed: int) -> None:
    T = model.forwardKinematics(random_q(seed))
    found, q = model.inverseKinematics(T, np.zeros(6), True)
    assert found
    assert model.forwardKinematics(q) == pytest.approx(T, abs=1e-5)


def test_joints_are_near_the_past_ones_unless_the_workspace_is_checked(model: Z1Model) -> None:
    T = model.forwardKinematics(FORWARD)
    assert not model.inverseKinematics(T, np.zeros(6), False)[0]
    found, q = model.inverseKinematics(T, FORWARD + 0.1, False)
    assert found
    assert q == pytest.approx(FORWARD, abs=1e-5)
    assert not model.inverseKinematics(postureToHomo([0, 0, 0, 2.0, 0, 0]), FORWARD, True)[0]


@pytest.mark.parametrize("seed", range(5))
def test_the_jacobian_is_the_derivative(model: Z1Model, seed: int) -> None:
    q, eps = random_q(seed), 1e-6
    T, J = model.forwardKinematics(q), model.CalcJacobian(q)
    for joint in range(6):
        V = (model.forwardKinematics(q + eps * np.eye(6)[joint]) - T) / eps @ np.linalg.inv(T)
        assert J[:, joint] == pytest.approx([V[2, 1], V[0, 2], V[1, 0], *V[:3, 3]], abs=1e-4)


def test_speeds_are_the_jacobians_inverse_where_the_limits_allow(model: Z1Model) -> None:
    twist = np.array([0, 0, 0, 0.1, 0, 0])
    q = FORWARD + np.array([0.1, 0.1, -0.1, 0.1, 0.2, 0.1])
    assert model.solveQP(twist, q, 0.002) == pytest.approx(np.linalg.solve(model.CalcJacobian(q), twist), abs=1e-4)


@pytest.mark.parametrize("seed", range(10))
def test_speeds_stay_within_the_limits_singular_or_not(model: Z1Model, seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = [z1.Q_MAX[:6], z1.Q_MIN[:6], REST, random_q(seed)][seed % 4]
    qd = model.solveQP(rng.uniform(-5, 5, 6), q, 0.002)
    assert np.isfinite(qd).all()
    assert (np.abs(qd) <= z1.DQ_MAX[:6] + 1e-9).all()
    assert (q + 0.002 * qd <= z1.Q_MAX[:6] + 1e-9).all()
    assert (q + 0.002 * qd >= z1.Q_MIN[:6] - 1e-9).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_posture_changes_at_the_requested_rates(model: Z1Model, seed: int) -> None:
    q = FORWARD + 0.2 * np.random.default_rng(seed).standard_normal(6) * [1, 1, -1, 1, 1, 1]
    rates = np.array([0.1, -0.05, 0.1, 0.03, 0.02, -0.05])
    moved = homoToPosture(model.forwardKinematics(q + 0.002 * model.end_speeds(rates, q, 0.002)))
    assert (moved - homoToPosture(model.forwardKinematics(q))) / 0.002 == pytest.approx(rates, abs=2e-3)


def test_the_torques_at_rest_are_the_slope_of_the_potential_energy(model: Z1Model) -> None:
    """Moving joint 2 by dq lifts 4.6 kg of arm, which its torque must carry."""
    tau = model.inverseDynamics(FORWARD, REST, REST, REST)
    assert tau[:4] == pytest.approx([0, -7.30, -8.07, -2.79], abs=0.01)
    bare = Z1Model().inverseDynamics(FORWARD, REST, REST, REST)
    assert np.abs(bare[1]) < np.abs(tau[1])


def test_a_force_at_the_end_costs_the_work_it_does(model: Z1Model) -> None:
    T = model.forwardKinematics(FORWARD)
    push = np.concatenate([REST[:3], T[:3, :3].T @ [0, 0, -10.0]])  # 10 N down, in the end's own frame
    extra = model.inverseDynamics(FORWARD, REST, REST, push) - model.inverseDynamics(FORWARD, REST, REST, REST)
    eps = 1e-6
    for joint in range(6):
        rise = model.forwardKinematics(FORWARD + eps * np.eye(6)[joint])[2, 3] - T[2, 3]
        assert extra[joint] == pytest.approx(-10.0 * rise / eps, abs=1e-3)


def test_a_load_adds_its_weight() -> None:
    light, heavy = Z1Model.with_gripper(), Z1Model.with_gripper()
    heavy.addLoad(1.0)
    T = light.forwardKinematics(FORWARD)
    push = np.concatenate([REST[:3], T[:3, :3].T @ [0, 0, 9.81]])  # the support pushes up
    assert heavy.inverseDynamics(FORWARD, REST, REST, REST) == pytest.approx(
        light.inverseDynamics(FORWARD, REST, REST, push), abs=1e-3
    )


def test_another_end_effector_changes_kinematics_and_dynamics() -> None:
    plain = Z1Model()
    loaded = Z1Model(np.array([0.0382, 0, 0]), 0.8, np.array([0.0037, 0, 0]), np.diag([5e-4, 1e-3, 1e-3]))
    assert np.linalg.norm(loaded.forwardKinematics(FORWARD)[:3, 3] - plain.forwardKinematics(FORWARD)[:3, 3]) == (
        pytest.approx(0.0382)
    )
    assert loaded.inverseDynamics(FORWARD, REST, REST, REST)[1] < plain.inverseDynamics(FORWARD, REST, REST, REST)[1]


def test_limits_and_singularities(model: Z1Model) -> None:
    q, qd = model.jointProtect(np.full(6, 9.0), np.full(6, -9.0))
    assert q.tolist() == model.getJointQMax()
    assert (-qd).tolist() == model.getJointSpeedMax()
    assert model.getJointQMin() == z1.Q_MIN[:6].tolist()
    assert not model.checkInSingularity(FORWARD)
    assert model.checkInSingularity(LABELS["startFlat"])


@pytest.mark.parametrize("q", [[0.0] * 5, [0.0] * 5 + [np.nan], "abc"])
def test_an_invalid_joint_vector_is_rejected(model: Z1Model, q: object) -> None:
    with pytest.raises(ValueError):
        model.forwardKinematics(q)
