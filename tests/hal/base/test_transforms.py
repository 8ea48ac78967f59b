"""Poses invert, measure and interpolate as rigid motions do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from hal.base import transforms

SEEDS = st.integers(0, 2**32 - 1)


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return transforms.make_pose(Rotation.random(rng=rng).as_matrix(), rng.uniform(-1.0, 1.0, 3))


@pytest.mark.integration
@given(SEEDS)
def test_a_pose_times_its_inverse_is_the_identity(seed: int) -> None:
    rng = np.random.default_rng(seed)
    Ts = np.stack([random_pose(rng) for _ in range(3)])
    np.testing.assert_allclose(Ts @ transforms.inverse(Ts), np.tile(np.eye(4), (3, 1, 1)), atol=1e-12)


@pytest.mark.integration
@given(SEEDS)
def test_interpolation_is_lerp_and_slerp(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_a, T_b, s = random_pose(rng), random_pose(rng), np.linspace(0.0, 1.0, 7)
    Ts = transforms.interpolate(T_a, T_b, s)
    reference = Slerp([0.0, 1.0], Rotation.from_matrix([T_a[:3, :3], T_b[:3, :3]]))(s).as_matrix()
    np.testing.assert_allclose(Ts[:, :3, :3], reference, atol=1e-7)
    np.testing.assert_allclose(Ts[:, :3, 3], (1 - s)[:, None] * T_a[:3, 3] + s[:, None] * T_b[:3, 3], atol=1e-12)
    np.testing.assert_allclose(Ts[[0, -1]], [T_a, T_b], atol=1e-7)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 0.5, 3.0, np.pi])
def test_pose_error_is_distance_and_angle(angle_rad: float) -> None:
    T_a = random_pose(np.random.default_rng(0))
    T_b = T_a @ transforms.make_pose(
        Rotation.from_rotvec([0.0, angle_rad, 0.0]).as_matrix(), np.array([0.03, 0.0, 0.04])
    )
    np.testing.assert_allclose(transforms.pose_error(T_a, T_b), (0.05, angle_rad), atol=1e-7)
