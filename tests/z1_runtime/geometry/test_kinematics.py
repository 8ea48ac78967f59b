"""Forward and inverse kinematics agree with each other, with the URDF, and with the joint limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hal.base import transforms, z1
from hal.base.errors import InvalidValueError
from tests.support.errors import raises
from z1_runtime.geometry.kinematics import (
    POSITION_TOLERANCE_M,
    ROTATION_TOLERANCE_RAD,
    IkFailure,
    Kinematics,
)

KINEMATICS = Kinematics()
Q_MIN, Q_MAX = z1.Q_MIN[: z1.N_ARM], z1.Q_MAX[: z1.N_ARM]
FRACTIONS = hnp.arrays(np.float64, z1.N_ARM, elements=st.floats(0.0, 1.0))
SHOULDER = np.array([0.0, 0.0, 0.1035])


def arm_joints(fraction: np.ndarray) -> np.ndarray:
    return Q_MIN + fraction * (Q_MAX - Q_MIN)


def two_branch_pose() -> tuple[np.ndarray, list[np.ndarray]]:
    """Return a pose the arm reaches in more than one way, and the ways."""
    rng = np.random.default_rng(3)
    while True:
        T = KINEMATICS.pivot(arm_joints(rng.uniform(0.2, 0.8, z1.N_ARM)))
        branches = KINEMATICS.solve(T)
        if len(branches) > 1:
            return T, branches


def turn_about(axis: int, q: float) -> np.ndarray:
    u, v = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[u, u] = R[v, v] = np.cos(q)
    R[u, v], R[v, u] = -np.sin(q), np.sin(q)
    return R


def test_the_flange_is_where_the_urdf_lengths_put_it_by_hand() -> None:
    # z1.urdf: origins of joint1 ... joint6 and their axes
    origins = [(0, 0, 0.0585), (0, 0, 0.045), (-0.35, 0, 0), (0.218, 0, 0.057), (0.07, 0, 0), (0.0492, 0, 0)]
    for q in (np.zeros(z1.N_ARM), z1.Q_HOME, arm_joints(np.full(z1.N_ARM, 0.3))):
        T = np.eye(4)
        for origin, axis, angle in zip(origins, (2, 1, 1, 1, 2, 0), q, strict=True):
            T = T @ transforms.make_pose(turn_about(axis, angle), np.array(origin))
        np.testing.assert_allclose(KINEMATICS.flange(q), T, atol=1e-9)


def test_the_pivot_is_100_mm_along_the_flange_x_axis() -> None:
    T_base_flange, T_base_pivot = KINEMATICS.flange(z1.Q_HOME), KINEMATICS.pivot(z1.Q_HOME)
    np.testing.assert_allclose(T_base_pivot[:3, 3] - T_base_flange[:3, 3], 0.1 * T_base_flange[:3, 0], atol=1e-12)
    np.testing.assert_allclose(T_base_pivot[:3, :3], T_base_flange[:3, :3], atol=1e-12)


def test_link_poses_start_at_the_base_and_turn_the_moving_jaw_about_the_pivot() -> None:
    closed = KINEMATICS.link_poses(np.append(z1.Q_HOME, 0.0))
    opened = KINEMATICS.link_poses(np.append(z1.Q_HOME, -1.0))
    np.testing.assert_array_equal(closed["link00"], np.eye(4))
    np.testing.assert_allclose(closed["link06"], KINEMATICS.flange(z1.Q_HOME), atol=1e-12)
    np.testing.assert_allclose(opened["gripperMover"][:3, 3], KINEMATICS.pivot(z1.Q_HOME)[:3, 3], atol=1e-9)
    np.testing.assert_allclose(
        closed["gripperMover"][:3, :3].T @ opened["gripperMover"][:3, :3], turn_about(1, -1.0), atol=1e-9
    )
    np.testing.assert_allclose(opened["gripperStator"], closed["gripperStator"], atol=1e-12)


@settings(max_examples=30)
@given(FRACTIONS)
def test_the_jacobian_is_the_derivative_of_the_pivot(fraction: np.ndarray) -> None:
    q, h = arm_joints(fraction), 1e-6
    numeric = [
        transforms.error_twist(KINEMATICS.pivot(q - h * e), KINEMATICS.pivot(q + h * e)) / (2 * h)
        for e in np.eye(z1.N_ARM)
    ]
    np.testing.assert_allclose(KINEMATICS.jacobian(q), np.transpose(numeric), atol=1e-7)


@pytest.mark.integration
@settings(max_examples=300)
@given(FRACTIONS)
def test_every_branch_reaches_the_pose_inside_the_limits(fraction: np.ndarray) -> None:
    T = KINEMATICS.pivot(arm_joints(fraction))
    branches = KINEMATICS.solve(T)
    assert branches
    for branch in branches:
        assert (branch >= Q_MIN).all()
        assert (branch <= Q_MAX).all()
        np.testing.assert_allclose(KINEMATICS.pivot(branch), T, atol=1e-6)


def test_the_joints_that_made_a_pose_are_among_its_branches() -> None:
    rng = np.random.default_rng(0)
    for q in arm_joints(rng.uniform(0.0, 1.0, (300, z1.N_ARM))):
        differences = [(branch - q + np.pi) % (2 * np.pi) - np.pi for branch in KINEMATICS.solve(KINEMATICS.pivot(q))]
        assert min(np.abs(difference).max() for difference in differences) < 1e-5


def test_poses_with_joints_exactly_at_their_limits_are_found() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        q = arm_joints(np.where(rng.random(z1.N_ARM) < 0.4, rng.integers(0, 2, z1.N_ARM), rng.random(z1.N_ARM)))
        T = KINEMATICS.pivot(q)
        assert any(max(transforms.pose_error(KINEMATICS.pivot(branch), T)) < 1e-6 for branch in KINEMATICS.solve(T))


def test_best_takes_the_branch_nearest_to_the_posture_it_is_given() -> None:
    T, branches = two_branch_pose()
    for branch in branches:
        result = KINEMATICS.best(T, q_near=branch)
        assert result.method == "analytic"
        assert result.n_branches == len(branches)
        np.testing.assert_array_equal(result.q, branch)
    by_hand = min(branches, key=lambda q: np.linalg.norm(q - z1.Q_HOME))
    np.testing.assert_array_equal(KINEMATICS.best(T).q, by_hand)


def test_a_pose_one_millimetre_out_of_reach_is_met_by_least_squares_within_its_tolerance() -> None:
    q = np.array([0.2, 1.3, 0.0, 0.1, 0.1, 0.3])  # the elbow straight: the arm cannot reach further
    T = KINEMATICS.pivot(q)
    outward = T[:3, 3] - SHOULDER
    T[:3, 3] += 0.001 * outward / np.linalg.norm(outward)
    assert KINEMATICS.solve(T) == []
    result = KINEMATICS.best(T)
    assert result.method == "least_squares"
    assert result.n_branches == 0
    assert 0.0 < result.position_error_m <= POSITION_TOLERANCE_M
    assert result.rotation_error_rad <= ROTATION_TOLERANCE_RAD
    assert (result.q >= Q_MIN).all()
    assert (result.q <= Q_MAX).all()
    assert transforms.pose_error(KINEMATICS.pivot(result.q), T) == (result.position_error_m, result.rotation_error_rad)


def test_an_unreachable_pose_is_refused_with_its_residual() -> None:
    T = KINEMATICS.pivot(z1.Q_HOME)
    T[:3, 3] = 2.0, 0.0, 0.3
    with raises(IkFailure, "unreachable") as failure:
        KINEMATICS.best(T)
    # The arm reaches at most 0.795 m from its shoulder
    assert 1.2 < failure.value.position_error_m < 1.6
    assert f"{failure.value.position_error_m * 1e3:.1f} mm" in str(failure.value)


def test_least_squares_finds_most_poses_that_the_algebra_finds() -> None:
    rng = np.random.default_rng(2)
    poses = [KINEMATICS.pivot(q) for q in arm_joints(rng.uniform(0.1, 0.9, (60, z1.N_ARM)))]
    found = 0
    for T in poses:
        try:
            result = KINEMATICS._best_least_squares(T, z1.Q_HOME)
        except IkFailure:
            continue
        found += 1
        position_error_m, rotation_error_rad = transforms.pose_error(KINEMATICS.pivot(result.q), T)
        assert position_error_m <= POSITION_TOLERANCE_M
        assert rotation_error_rad <= ROTATION_TOLERANCE_RAD
    assert found >= 0.7 * len(poses)


def test_follow_stays_on_its_branch_along_a_line() -> None:
    T_goal = KINEMATICS.pivot(z1.Q_HOME)
    T_goal[:3, 3] += 0.08, 0.03, -0.05
    Ts = transforms.interpolate(KINEMATICS.pivot(z1.Q_HOME), T_goal, np.linspace(0.0, 1.0, 21))
    qs = KINEMATICS.follow(Ts, z1.Q_HOME)
    assert qs.shape == (21, z1.N_ARM)
    np.testing.assert_allclose(qs[0], z1.Q_HOME, atol=1e-9)
    assert np.abs(np.diff(qs, axis=0)).max() < 0.15
    for q, T in zip(qs, Ts, strict=True):
        np.testing.assert_allclose(KINEMATICS.pivot(q), T, atol=1e-6)


def test_follow_names_the_joint_that_would_jump() -> None:
    T, branches = two_branch_pose()
    start = branches[0].copy()
    start[4] += 0.2 if start[4] < 0.0 else -0.2
    with raises(IkFailure, "branch_jump") as failure:
        KINEMATICS.follow(T[None], start)
    assert (failure.value.waypoint, failure.value.joint) == (0, "joint5")


def test_follow_names_the_first_waypoint_out_of_reach() -> None:
    T_goal = KINEMATICS.pivot(z1.Q_HOME)
    T_goal[:3, 3] += 1.0, 0.0, 0.0
    Ts = transforms.interpolate(KINEMATICS.pivot(z1.Q_HOME), T_goal, np.linspace(0.0, 1.0, 201))
    with raises(IkFailure, "waypoint_unreachable") as failure:
        KINEMATICS.follow(Ts, z1.Q_HOME)
    waypoint = failure.value.waypoint
    assert waypoint is not None
    assert KINEMATICS.solve(Ts[waypoint]) == []
    assert len(KINEMATICS.follow(Ts[:waypoint], z1.Q_HOME)) == waypoint


@pytest.mark.parametrize("fault", ["nan", "shape", "mirror", "scale"])
def test_an_invalid_pose_is_rejected(fault: str) -> None:
    T = np.eye(4)
    if fault == "nan":
        T[0, 3] = np.nan
    elif fault == "shape":
        T = T[:3]
    elif fault == "mirror":
        T[0, 0] = -1.0
    else:
        T[:3, :3] *= 2.0
    with raises(InvalidValueError, "pose"):
        KINEMATICS.solve(T)
