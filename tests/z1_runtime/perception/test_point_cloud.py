"""Each equation against hand figures or brute force."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from hal.base.errors import InvalidValueError
from hal.base.messages import Intrinsics
from hal.base.transforms import transform_points
from tests.support.errors import raises
from tests.support.tabletop_scene import INTRINSICS, Box, T_base_camera, cast
from z1_runtime.perception import point_cloud


def brute_distances(points):
    return np.linalg.norm(points[:, None] - points[None], axis=2)


def test_back_projection_gives_the_numbers_worked_out_by_hand():
    intrinsics = Intrinsics(width=4, height=3, fx=200.0, fy=100.0, cx=1.0, cy=2.0)
    depth = np.zeros((3, 4), np.float32)
    depth[0, 3], depth[2, 1] = 0.5, 0.25
    points = point_cloud.back_project(depth, intrinsics, depth > 0)
    # ((3 − 1) · 0.5 / 200, (0 − 2) · 0.5 / 100, 0.5), and the principal point on the axis.
    np.testing.assert_allclose(points, [[0.005, -0.01, 0.5], [0.0, 0.0, 0.25]], atol=1e-15)


def test_back_projection_inverts_the_camera_matrix():
    depth, _ = cast([Box(0.45, 0, (0.06, 0.1, 0.18))])
    pixels = point_cloud.valid_pixels(depth, 1.0)
    image = point_cloud.back_project(depth, INTRINSICS, pixels) @ INTRINSICS.K.T
    v, u = np.nonzero(pixels)
    np.testing.assert_allclose(image[:, :2] / image[:, 2:], np.column_stack([u, v]), atol=1e-9)


def test_back_projection_refuses_pixels_of_another_image():
    with raises(InvalidValueError, "image_shape"):
        point_cloud.back_project(np.ones((3, 4)), INTRINSICS, np.ones((4, 3), bool))


def test_unmeasured_and_far_pixels_are_invalid():
    depth = np.array([[0.0, 0.5, 1.0, 1.0001]], np.float32)
    assert point_cloud.valid_pixels(depth, 1.0).tolist() == [[False, True, True, False]]


def test_a_box_crop_ends_before_its_upper_edges_and_at_the_image():
    pixels = point_cloud.box_pixels((4, 5), (1, -2, 3, 2))
    assert np.argwhere(pixels).tolist() == [[0, 1], [0, 2], [1, 1], [1, 2]]
    assert not point_cloud.box_pixels((4, 5), (9, 9, 12, 12)).any()


def test_a_lone_depth_between_two_surfaces_is_not_continuous():
    depth = np.full((7, 9), 0.3)
    depth[:, 5:] = 0.6
    depth[3, 5] = 0.45
    continuous = point_cloud.continuous_pixels(depth)
    assert not continuous[3, 5]
    assert continuous.sum() == depth.size - 1


def test_a_hole_is_continuous_with_no_neighbour_and_its_rim_stays():
    depth = np.full((9, 9), 0.3)
    depth[3:6, 3:6] = 0.0
    assert (point_cloud.continuous_pixels(depth) == (depth > 0)).all()


def test_transform_applies_the_pose_and_its_inverse_undoes_it():
    T = T_base_camera()
    points = np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_allclose(transform_points(T, np.zeros((1, 3)))[0], T[:3, 3])
    np.testing.assert_allclose(transform_points(np.linalg.inv(T), transform_points(T, points)), points, atol=1e-12)


def test_the_depth_clip_keeps_points_between_the_percentiles():
    points = np.zeros((101, 3))
    points[:, 2] = np.random.default_rng(0).permutation(101)  # percentile p of 0…100 is p
    assert sorted(points[point_cloud.depth_clip(points), 2]) == list(range(1, 100))
    assert sorted(points[point_cloud.depth_clip(points, 10, 90), 2]) == list(range(10, 91))


def test_the_statistical_filter_is_mean_plus_two_sigma_of_the_mean_neighbour_distance():
    rng = np.random.default_rng(1)
    points = np.vstack([rng.normal(scale=0.01, size=(300, 3)), rng.uniform(-0.2, 0.2, size=(12, 3))])
    mean = np.sort(brute_distances(points), axis=1)[:, 1:9].mean(axis=1)
    expected = mean <= mean.mean() + 2 * mean.std()
    keep = point_cloud.statistical_inliers(points, k=8, n_sigma=2.0)
    assert (keep == expected).all()
    assert 0 < (~keep).sum() < 20


def test_the_statistical_filter_leaves_clouds_smaller_than_its_neighbourhood_alone():
    points = np.random.default_rng(0).normal(size=(8, 3))
    assert point_cloud.statistical_inliers(points, k=8).all()


def test_the_radius_filter_counts_neighbours_as_brute_force_does():
    rng = np.random.default_rng(2)
    points = rng.uniform(0, 0.05, size=(400, 3))
    expected = (brute_distances(points) <= 0.008).sum(axis=1) - 1 >= 5
    keep = point_cloud.radius_inliers(points, radius_m=0.008, min_neighbours=5)
    assert (keep == expected).all()
    assert 0.1 < keep.mean() < 0.9


def test_a_neighbour_exactly_at_the_radius_counts():
    points = np.array([[0.0, 0, 0], [0.5, 0, 0], [1.25, 0, 0]])
    assert point_cloud.radius_inliers(points, radius_m=0.5, min_neighbours=1).tolist() == [True, True, False]


def test_voxels_are_replaced_by_the_centroid_of_their_points():
    points = np.array([[0.001, 0.001, 0.001], [0.003, 0.001, 0.002], [-0.001, 0.0, 0.0], [0.011, 0.0, 0.0]])
    got = point_cloud.voxel_downsample(points, 0.01)
    np.testing.assert_allclose(got, [[-0.001, 0, 0], [0.002, 0.001, 0.0015], [0.011, 0, 0]], atol=1e-12)


def test_voxels_thin_evenly_and_lose_no_point_by_more_than_a_voxel():
    points = np.random.default_rng(3).uniform(0, 0.1, size=(5000, 3))
    got = point_cloud.voxel_downsample(points, 0.01)
    assert len(got) <= 1000
    assert KDTree(got).query(points)[0].max() <= 0.01 * np.sqrt(3)


def test_subsampling_repeats_with_its_seed_and_keeps_small_clouds_whole():
    points = np.zeros((1000, 3))
    first = point_cloud.subsample(points, 100, seed=4)
    assert (first == point_cloud.subsample(points, 100, seed=4)).all()
    assert (first != point_cloud.subsample(points, 100, seed=5)).any()
    assert len(np.unique(first)) == 100
    assert (point_cloud.subsample(points, 1000) == np.arange(1000)).all()


@pytest.mark.parametrize(
    "filter_", [point_cloud.depth_clip, point_cloud.statistical_inliers, point_cloud.radius_inliers]
)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_cloud_that_is_not_finite_is_refused(filter_, bad):
    points = np.ones((100, 3))
    points[7, 1] = bad
    with raises(InvalidValueError, "not_finite"):
        filter_(points)


def test_a_cloud_of_the_wrong_shape_is_refused():
    with raises(InvalidValueError, "cloud_shape"):
        point_cloud.statistical_inliers(np.ones((100, 2)))


def test_empty_clouds_pass_through_the_filters():
    nothing = np.zeros((0, 3))
    assert len(point_cloud.depth_clip(nothing)) == len(point_cloud.statistical_inliers(nothing)) == 0
    assert len(point_cloud.radius_inliers(nothing)) == len(point_cloud.voxel_downsample(nothing, 0.01)) == 0
