"""The table against analytic scenes with a D405's errors."""

import numpy as np
import pytest

from hal.base.errors import InvalidValueError
from hal.base.transforms import transform_points
from tests.support.errors import raises
from tests.support.tabletop_scene import INTRINSICS, Box, T_base_camera, cast, d405
from z1_runtime.perception.detector import NoTableError
from z1_runtime.perception.point_cloud import back_project, valid_pixels
from z1_runtime.perception.table_plane import TableConfig, TableFit, expected_table, fit_table
from z1_runtime.types import Plane


def scene(objects, seed=0, **table):
    depth = d405(cast(objects, **table)[0], seed)
    return back_project(depth, INTRINSICS, valid_pixels(depth, 1.0))


def table_error(plane: Plane, tilt_rad=0.0, lift_m=0.0):
    """Return the angle [rad] to the true table and the height error [m] at (0.5, 0) on it."""
    T = T_base_camera()
    normal = T[:3, :3].T @ [-np.sin(tilt_rad), 0, np.cos(tilt_rad)]
    point = T[:3, :3].T @ (np.array([0.5, 0.0, lift_m + 0.5 * np.tan(tilt_rad)]) - T[:3, 3])
    return np.arccos(min(1.0, plane.normal @ normal)), abs(plane.height_m(point[None])[0])


@pytest.mark.parametrize(("seed", "tilt_rad", "lift_m"), [(0, 0.0, 0.0), (1, 0.03, 0.0), (2, -0.03, 0.015)])
def test_the_table_is_found_within_half_a_millimetre_and_a_third_of_a_degree(seed, tilt_rad, lift_m):
    points = scene([Box(0.48, 0.05, (0.06, 0.1, 0.18), 0.4)], seed, tilt_rad=tilt_rad, lift_m=lift_m)
    fit = fit_table(points, expected_table(T_base_camera()))
    angle, height = table_error(fit.plane, tilt_rad, lift_m)
    assert angle < np.deg2rad(0.3)
    assert height < 0.0005


def test_the_table_of_an_exact_depth_image_is_exact():
    depth, _ = cast([])
    points = back_project(depth, INTRINSICS, valid_pixels(depth, 1.0))
    fit = fit_table(points)
    angle, height = table_error(fit.plane)
    assert angle < 1e-6
    assert height < 1e-9
    assert fit.noise_per_m < 1e-6


def test_the_normal_points_at_the_camera():
    plane = fit_table(scene([])).plane
    assert plane.height_m(np.zeros((1, 3)))[0] == pytest.approx(T_base_camera()[2, 3], abs=0.001)
    assert np.linalg.norm(plane.normal) == pytest.approx(1.0)


def test_a_box_face_that_fills_the_view_is_not_the_table_when_one_is_expected():
    points = scene([Box(0.45, 0.0, (0.1, 0.45, 0.25))])
    angle_without, _ = table_error(fit_table(points).plane)
    angle, height = table_error(fit_table(points, expected_table(T_base_camera())).plane)
    assert angle_without > np.deg2rad(60)
    assert angle < np.deg2rad(0.3)
    assert height < 0.0005


def test_a_wide_low_box_does_not_lift_the_table():
    points = scene([Box(0.48, 0.0, (0.15, 0.2, 0.03))])
    _, height = table_error(fit_table(points, expected_table(T_base_camera())).plane)
    assert height < 0.0005


def test_the_same_seed_gives_the_same_plane_bit_by_bit():
    points = scene([Box(0.48, 0.05, (0.06, 0.1, 0.18), 0.4)])
    first, second = (fit_table(points, seed=3) for _ in range(2))
    assert first.plane.normal.tobytes() == second.plane.normal.tobytes()
    assert first.plane.offset_m == second.plane.offset_m


def test_the_table_noise_is_measured():
    # σ_z = z² · 0.08 px / (f B) along a ray that meets the table at about 40°.
    along_ray = 0.08 / (INTRINSICS.fx * 0.018)
    fit = fit_table(scene([]), expected_table(T_base_camera()))
    assert 0.4 * along_ray < fit.noise_per_m < along_ray


def test_the_threshold_above_the_table_grows_with_the_noise():
    plane = Plane(normal=np.array([0.0, -1.0, 0.0]), offset_m=-0.3)  # heights are 0.3 − y
    fit = TableFit(plane=plane, noise_per_m=0.01)
    points = np.array([[0, 0.294, 0.2], [0, 0.296, 0.2], [0, 0.294, 0.6], [0, 0.288, 0.6]])
    assert fit.above(points, min_height_m=0.005).tolist() == [True, False, False, True]


def test_nothing_near_the_expected_table_is_an_error():
    face = scene([Box(0.45, 0.0, (0.1, 0.45, 0.25))])
    face = face[transform_points(T_base_camera(), face)[:, 2] > 0.06]
    with raises(NoTableError, "no_table"):
        fit_table(face, expected_table(T_base_camera()))
    with pytest.raises(NoTableError):
        fit_table(np.zeros((0, 3)))


def test_scattered_points_are_no_table():
    rng = np.random.default_rng(0)
    config = TableConfig(min_inliers=2000)
    with raises(NoTableError, "no_table"):
        fit_table(rng.uniform([-0.3, -0.3, 0.3], [0.3, 0.3, 0.9], size=(8000, 3)), config=config)


def test_points_behind_the_camera_are_refused():
    with raises(InvalidValueError, "behind_camera"):
        fit_table(np.random.default_rng(0).normal(size=(1000, 3)))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_cloud_that_is_not_finite_is_refused(bad):
    points = np.ones((100, 3))
    points[7, 1] = bad
    with raises(InvalidValueError, "not_finite"):
        fit_table(points)
