"""The pinhole: projection and deprojection are inverse to each other."""

import numpy as np
import pytest

from hal.base.messages import Intrinsics

INTRINSICS = Intrinsics(width=64, height=48, fx=50.0, fy=52.0, cx=31.2, cy=23.9)


def test_deprojected_pixels_project_back() -> None:
    rng = np.random.default_rng(0)
    u, v, z = rng.uniform(0, 64, 100), rng.uniform(0, 48, 100), rng.uniform(0.1, 2.0, 100)
    np.testing.assert_allclose(INTRINSICS.project(INTRINSICS.deproject(u, v, z)), np.column_stack([u, v]), atol=1e-9)


def test_a_ray_is_the_point_at_unit_depth() -> None:
    rays = INTRINSICS.rays()
    assert rays.shape == (48, 64, 3)
    point = INTRINSICS.deproject(np.array([5.0]), np.array([7.0]), np.array([1.0]))[0]
    assert rays[7, 5] == pytest.approx(point)


def test_the_camera_matrix_projects_alike() -> None:
    point = np.array([0.1, -0.05, 0.6])
    u, v, w = INTRINSICS.K @ point
    assert INTRINSICS.project(point[None])[0] == pytest.approx([u / w, v / w])
