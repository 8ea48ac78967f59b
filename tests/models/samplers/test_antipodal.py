"""The antipodal sampler, on single views of a cylinder and of a box."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hal.base.errors import InvalidValueError
from models.obb.mvbb import fit_obb, rank_grasps
from models.samplers.antipodal import AntipodalConfig, AntipodalSampler
from models.samplers.surfels import estimate_normals, estimate_occluded_sides, find_outline
from models.types import GraspSet
from tests.support.errors import raises

UP = np.array([0.0, -1.0, 0.0])
CENTER = np.array([0.02, 0.01, 0.4])
RADIUS_M = 0.03
HALF = np.array([0.02, 0.075, 0.035])


def make_cylinder_view(seed: int = 0, n: int = 3000) -> np.ndarray:
    """Return the visible wall (n, 3) of an upright cylinder, even in the image, with 0.5 mm noise along the rays."""
    rng = np.random.default_rng(seed)
    sine = rng.uniform(-0.99, 0.99, n)
    wall = np.stack([RADIUS_M * sine, rng.uniform(-0.07, 0.07, n), -RADIUS_M * np.sqrt(1.0 - sine**2)], axis=1)
    return with_noise(wall + CENTER, rng)


def make_front_view(seed: int = 0, n: int = 3000) -> np.ndarray:
    """Return the front face (n, 3) of a box, square to the view, with 0.5 mm noise along the rays."""
    rng = np.random.default_rng(seed)
    face = rng.uniform(-HALF, HALF, (n, 3))
    face[:, 2] = -HALF[2]
    return with_noise(face + np.array([0.0, 0.0, 0.4]), rng)


def with_noise(cloud: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return cloud * (1.0 + rng.normal(0.0, 5e-4, (len(cloud), 1)) / np.linalg.norm(cloud, axis=1, keepdims=True))


@pytest.fixture(scope="module")
def cylinder_grasps() -> GraspSet:
    return AntipodalSampler().sample(make_cylinder_view(), 400, seed=0)


@pytest.mark.parametrize("n", [1, 7, 800])
def test_exactly_the_requested_number_of_grasps_is_returned(n: int):
    grasps = AntipodalSampler().sample(make_cylinder_view(), n, seed=3)
    assert len(grasps) == n and grasps.T_camera_grasps.shape == (n, 4, 4)


def test_every_grasp_is_a_rigid_pose_with_a_score_and_a_width_within_the_opening(cylinder_grasps: GraspSet):
    R = cylinder_grasps.T_camera_grasps[:, :3, :3]
    np.testing.assert_allclose(R.transpose(0, 2, 1) @ R, np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_array_equal(cylinder_grasps.T_camera_grasps[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (len(R), 1)))
    assert (cylinder_grasps.scores >= 0.0).all() and (cylinder_grasps.scores <= 1.0).all()
    assert (np.diff(cylinder_grasps.scores) <= 0.0).all() and np.ptp(cylinder_grasps.scores) > 0.1
    assert (cylinder_grasps.widths_m > 0.0).all() and (cylinder_grasps.widths_m <= 0.085).all()


@pytest.mark.integration
def test_the_same_seed_gives_the_same_grasps_and_another_seed_others():
    cloud, sampler = make_cylinder_view(), AntipodalSampler()
    first, again, other = (sampler.sample(cloud, 100, seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.T_camera_grasps, again.T_camera_grasps)
    np.testing.assert_array_equal(first.scores, again.scores)
    assert not np.allclose(first.T_camera_grasps, other.T_camera_grasps)


def test_a_cylinder_viewed_from_the_front_is_held_across_its_axis(cylinder_grasps: GraspSet):
    frontal = cylinder_grasps[cylinder_grasps.T_camera_grasps[:, 2, 2] > np.cos(np.pi / 4)]
    assert len(frontal) > 40
    closing = frontal.T_camera_grasps[:, :3, 1]
    assert np.mean(np.abs(closing @ UP) < np.sin(np.deg2rad(15))) > 0.9
    assert np.mean(np.abs(frontal.widths_m - 2 * RADIUS_M) < 6e-3) > 0.9
    to_axis = np.sum((frontal.T_camera_grasps[:, :3, 3] - CENTER)[:, [0, 2]] * closing[:, [0, 2]], axis=1)
    assert np.mean(np.abs(to_axis) < 4e-3) > 0.9


def test_frontal_grasps_spread_over_the_height_of_the_object(cylinder_grasps: GraspSet):
    frontal = cylinder_grasps[cylinder_grasps.T_camera_grasps[:, 2, 2] > np.cos(np.pi / 4)]
    assert np.ptp(frontal.T_camera_grasps[:, 1, 3]) > 0.08


def test_a_flat_front_is_held_by_its_hidden_sides():
    grasps = AntipodalSampler().sample(make_front_view(), 400, seed=0)
    frontal = grasps[grasps.T_camera_grasps[:, 2, 2] > np.cos(np.deg2rad(30))]
    assert len(frontal) > 20
    assert np.mean(np.abs(frontal.T_camera_grasps[:, 0, 1]) > np.cos(np.deg2rad(10))) > 0.9
    assert np.median(np.abs(frontal.widths_m - 2 * HALF[0])) < 2e-3
    fingertips_behind_the_face = frontal.T_camera_grasps[:, 2, 3] - (0.4 - HALF[2])
    assert np.median(fingertips_behind_the_face) > 0.005


def test_most_grasps_are_clear_of_the_visible_points(cylinder_grasps: GraspSet):
    cloud = make_cylinder_view()
    clear = []
    for T, width_m in zip(cylinder_grasps.T_camera_grasps[:100], cylinder_grasps.widths_m[:100], strict=True):
        x, y, z = ((cloud - T[:3, 3]) @ T[:3, :3]).T
        finger = (np.abs(x) < 0.01) & (np.abs(y) > width_m / 2 + 0.004) & (np.abs(y) < width_m / 2 + 0.016)
        clear.append(np.count_nonzero(finger & (z < 0) & (z > -0.05)) <= 5)
    assert np.mean(clear) > 0.9


def test_the_best_ranked_grasps_come_from_the_front_and_hold_the_cylinder(cylinder_grasps: GraspSet):
    ranked = rank_grasps(cylinder_grasps, fit_obb(make_cylinder_view(), up=UP), k=1)
    best = ranked.grasps[:10]
    assert (best.T_camera_grasps[:, 2, 2] > np.cos(np.deg2rad(35))).all()
    assert (np.abs(best.widths_m - 2 * RADIUS_M) < 6e-3).all()


def test_turning_the_camera_turns_the_grasps():
    cloud = make_cylinder_view()
    R = Rotation.from_rotvec([0.3, -0.9, 0.5]).as_matrix()
    before, after = (AntipodalSampler().sample(points, 200, seed=1) for points in (cloud, cloud @ R.T))
    np.testing.assert_allclose(after.scores.mean(), before.scores.mean(), atol=0.03)
    turned = before.T_camera_grasps[:, :3, 3].mean(axis=0) @ R.T
    np.testing.assert_allclose(after.T_camera_grasps[:, :3, 3].mean(axis=0), turned, atol=8e-3)
    assert abs(np.median(after.widths_m) - np.median(before.widths_m)) < 2e-3


BAD_CLOUDS = {
    "empty": (np.zeros((0, 3)), "cloud_points"),
    "29 points": (make_cylinder_view(n=29), "cloud_points"),
    "nan": (np.vstack([make_cylinder_view(), [[np.nan, 0.0, 0.4]]]), "cloud_not_finite"),
    "infinite": (np.vstack([make_cylinder_view(), [[0.0, np.inf, 0.4]]]), "cloud_not_finite"),
    "two columns": (np.ones((100, 2)), "cloud_points"),
    "one place": (np.full((100, 3), 0.4), "no_grasps"),
    "behind the camera": (make_cylinder_view() - [0.0, 0.0, 0.4], "cloud_behind_camera"),
    "wider than the gripper": (make_front_view() * 4.0, "no_grasps"),
}


@pytest.mark.parametrize(("cloud", "code"), BAD_CLOUDS.values(), ids=BAD_CLOUDS)
def test_a_cloud_without_grasps_is_rejected(cloud: np.ndarray, code: str):
    with raises(InvalidValueError, code):
        AntipodalSampler().sample(cloud, 100, seed=0)


def test_unusable_settings_are_rejected():
    with raises(InvalidValueError, "gripper_width"):
        AntipodalConfig(max_width_m=0.001)
    with raises(InvalidValueError, "gripper_depth"):
        AntipodalConfig(max_depth_m=0.06)
    with raises(InvalidValueError, "sampling"):
        AntipodalConfig(oversampling=0.5)
    with raises(InvalidValueError, "grasp_count"):
        AntipodalSampler().sample(make_cylinder_view(), 0, seed=0)


def test_a_narrower_gripper_gives_no_wider_grasp():
    grasps = AntipodalSampler(AntipodalConfig(max_width_m=0.05)).sample(make_front_view(), 100, seed=0)
    assert grasps.widths_m.max() <= 0.05


def test_normals_of_a_cylinder_point_out_of_it_and_to_the_camera():
    from scipy.spatial import KDTree

    cloud = make_cylinder_view()
    normals = estimate_normals(KDTree(cloud), cloud)
    outward = (cloud - CENTER) * [1.0, 0.0, 1.0]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    inner = np.abs(cloud[:, 0] - CENTER[0]) < 0.8 * RADIUS_M
    assert np.median(np.sum(normals * outward, axis=1)[inner]) > np.cos(np.deg2rad(6))
    assert (np.sum(normals * cloud, axis=1) <= 0.0).all()


def test_the_outline_of_a_front_face_is_its_four_edges_without_the_corners():
    cloud = make_front_view()
    rim, outward = find_outline(cloud)
    inside = np.minimum(HALF[0] - np.abs(cloud[rim, 0]), HALF[1] - np.abs(cloud[rim, 1]))
    assert len(rim) > 60 and np.percentile(inside, 95) < 3e-3
    assert np.mean(np.abs(outward[:, :2]).max(axis=1) > np.cos(np.deg2rad(12))) > 0.85


def test_the_side_behind_a_flat_edge_is_square_to_the_face_and_behind_it():
    from scipy.spatial import KDTree

    cloud = make_front_view()
    rim, outward = find_outline(cloud)
    sides = estimate_occluded_sides(cloud, KDTree(cloud), rim, outward, 0.008)
    assert np.median(np.abs(sides.normals[:, 2])) < np.sin(np.deg2rad(5))
    assert np.median(sides.points[:, 2] - cloud[rim, 2]) == pytest.approx(0.008, abs=1e-3)
