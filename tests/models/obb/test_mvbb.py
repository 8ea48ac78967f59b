"""The box around the object, and the ranking of grasps by its faces."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hal.base.errors import InvalidValueError
from models.obb.mvbb import FitMethod, fit_obb, nearest_faces, rank_by_score, rank_grasps
from models.obb.obb import DegenerateCloudError, OrientedBox
from models.types import GraspSet
from tests.support.errors import raises

METHODS: tuple[FitMethod, ...] = ("pca", "min_volume", "upright")
UP = np.array([0.0, -1.0, 0.0])
SEEDS = st.integers(0, 10_000)


def make_solid(rng: np.random.Generator, half: np.ndarray, n: int = 600) -> np.ndarray:
    """Return n points (n, 3) inside a box of those half extents, its eight corners among them."""
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T * half
    return np.concatenate([corners, rng.uniform(-half, half, (n - 8, 3))])


def make_upright_view(
    rng: np.random.Generator, half: np.ndarray, yaw_rad: float, position: np.ndarray, noise_m: float = 7e-4
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (4000, 3) of an upright box in a level camera (y is down), and its rotation (3, 3)."""
    R = Rotation.from_euler("y", yaw_rad).as_matrix()
    normals = np.concatenate([R.T, -R.T])
    centers = position + normals * np.tile(half, 2)[:, None]
    facing = np.maximum(-np.sum(normals * centers, axis=1) / np.linalg.norm(centers, axis=1), 0.0)
    areas = np.tile(4.0 * np.prod(half) / half, 2) * facing
    points = []
    for face, count in enumerate(rng.multinomial(4000, areas / areas.sum())):
        local = rng.uniform(-half, half, (count, 3))
        local[:, face % 3] = half[face % 3] * (1.0 if face < 3 else -1.0)
        points.append(local @ R.T + position)
    cloud = np.concatenate(points)
    return cloud * (1.0 + rng.normal(0.0, noise_m, (len(cloud), 1)) / np.linalg.norm(cloud, axis=1, keepdims=True)), R


def make_box(half: tuple[float, float, float] = (0.02, 0.05, 0.03), z_m: float = 0.4) -> OrientedBox:
    T = np.eye(4)
    T[2, 3] = z_m
    return OrientedBox(T_camera_box=T, half_extents_m=np.array(half), unobserved=np.zeros(3, bool))


def make_grasps(approaches: np.ndarray, scores: np.ndarray) -> GraspSet:
    """Return grasps whose z axes are `approaches` (N, 3)."""
    T = np.tile(np.eye(4), (len(approaches), 1, 1))
    for pose, approach in zip(T, approaches, strict=True):
        z_axis = approach / np.linalg.norm(approach)
        helper = np.eye(3)[np.argmin(np.abs(z_axis))]
        y_axis = np.cross(z_axis, helper) / np.linalg.norm(np.cross(z_axis, helper))
        pose[:3, :3] = np.stack([np.cross(y_axis, z_axis), y_axis, z_axis], axis=1)
    return GraspSet(T_camera_grasps=T, scores=scores, widths_m=np.full(len(scores), 0.05), source="test")


def make_random_grasps(rng: np.random.Generator, n: int = 60) -> GraspSet:
    return make_grasps(rng.normal(size=(n, 3)), rng.uniform(size=n))


def same_corners(a: np.ndarray, b: np.ndarray) -> float:
    """Return the greatest distance [m] from a corner of `a` (8, 3) to the nearest of `b` (8, 3)."""
    return float(np.linalg.norm(a[:, None] - b, axis=2).min(axis=1).max())


def test_faces_of_a_known_box_have_their_true_centers_and_outward_normals():
    box = make_box()
    expected = [[0.02, 0, 0.4], [-0.02, 0, 0.4], [0, 0.05, 0.4], [0, -0.05, 0.4], [0, 0, 0.43], [0, 0, 0.37]]
    np.testing.assert_allclose(box.face_centers_m, expected, atol=1e-15)
    np.testing.assert_allclose(box.face_normals, np.repeat(np.eye(3), 2, axis=0) * np.tile([[1], [-1]], (3, 1)))
    assert box.volume_m3 == pytest.approx(0.04 * 0.10 * 0.06)
    np.testing.assert_allclose(box.corners_m[0], [-0.02, -0.05, 0.37])
    np.testing.assert_allclose(box.corners_m[-1], [0.02, 0.05, 0.43])


def test_a_box_rejects_arrays_of_the_wrong_shape():
    with raises(InvalidValueError, "shape"):
        OrientedBox(T_camera_box=np.eye(3), half_extents_m=np.ones(3), unobserved=np.zeros(3, bool))


@pytest.mark.parametrize("method", METHODS)
def test_every_method_finds_the_exact_box_of_a_full_grid(method: FitMethod):
    half = np.array([0.03, 0.09, 0.05])
    grid = np.stack(np.meshgrid(*(np.linspace(-h, h, 9) for h in half)), axis=-1).reshape(-1, 3)
    R = Rotation.from_euler("y", 0.3).as_matrix()
    box = fit_obb(grid @ R.T + [0.02, 0.03, 0.4], method, up=UP, percentile=(0, 100))
    np.testing.assert_allclose(np.sort(box.half_extents_m), [0.03, 0.05, 0.09], atol=4e-4)
    np.testing.assert_allclose(box.center_m, [0.02, 0.03, 0.4], atol=1e-4)


@settings(max_examples=25)
@given(seed=SEEDS, method=st.sampled_from(METHODS))
def test_every_fit_is_right_handed_and_its_percentile_box_holds_most_points(seed: int, method: FitMethod):
    rng = np.random.default_rng(seed)
    R = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    points = make_solid(rng, rng.uniform(0.01, 0.1, 3)) @ R.T + [0, 0, 0.4]
    box = fit_obb(points, method, up=rng.normal(size=3))
    np.testing.assert_allclose(box.R_camera_box.T @ box.R_camera_box, np.eye(3), atol=1e-9)
    assert np.linalg.det(box.R_camera_box) == pytest.approx(1.0)
    local = np.abs((points - box.center_m) @ box.R_camera_box)
    assert np.mean((local <= box.half_extents_m + 1e-9).all(axis=1)) >= 0.93


@settings(max_examples=20)
@given(seed=SEEDS, method=st.sampled_from(("pca", "min_volume")))
def test_pca_and_min_volume_boxes_move_rigidly_with_the_points(seed: int, method: FitMethod):
    rng = np.random.default_rng(seed)
    half = np.array([0.03, 0.05, 0.09]) * rng.uniform(0.9, 1.1, 3)
    points = make_solid(rng, half) + np.array([0, 0, 0.4])
    R, p = Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.uniform(-0.2, 0.2, 3)
    before, after = fit_obb(points, method), fit_obb(points @ R.T + p, method)
    assert same_corners(before.corners_m @ R.T + p, after.corners_m) < 1e-6


@settings(max_examples=20)
@given(seed=SEEDS, method=st.sampled_from(METHODS))
def test_the_order_of_the_points_does_not_matter(seed: int, method: FitMethod):
    rng = np.random.default_rng(seed)
    points = make_solid(rng, np.array([0.03, 0.05, 0.09])) + np.array([0.05, 0, 0.4])
    first, second = fit_obb(points, method, up=UP), fit_obb(rng.permutation(points), method, up=UP)
    np.testing.assert_allclose(first.T_camera_box, second.T_camera_box, atol=1e-6)
    np.testing.assert_allclose(first.half_extents_m, second.half_extents_m, atol=1e-6)


@settings(max_examples=15)
@given(seed=SEEDS)
def test_no_box_is_smaller_than_the_min_volume_box(seed: int):
    rng = np.random.default_rng(seed)
    half = rng.uniform(0.01, 0.1, 3)
    points = make_solid(rng, half) @ Rotation.from_quat(rng.normal(size=4)).as_matrix().T + [0, 0, 0.5]
    smallest = fit_obb(points, "min_volume", percentile=(0, 100)).volume_m3
    assert smallest <= fit_obb(points, "pca", percentile=(0, 100)).volume_m3 * (1 + 1e-9)
    assert smallest == pytest.approx(8 * np.prod(half), rel=1e-6)


def test_axis_signs_follow_the_written_convention():
    points = make_solid(np.random.default_rng(0), np.array([0.09, 0.05, 0.03])) + np.array([0.02, 0.03, 0.4])
    for method in ("pca", "min_volume"):
        box = fit_obb(points, method)
        assert box.half_extents_m[0] >= box.half_extents_m[1] >= box.half_extents_m[2]
        assert (-box.center_m @ box.R_camera_box)[:2].min() > 0.0
    upright = fit_obb(points, up=2.5 * UP)
    np.testing.assert_allclose(upright.R_camera_box[:, 2], UP, atol=1e-12)
    toward_camera = -upright.center_m @ upright.R_camera_box
    assert toward_camera[0] > abs(toward_camera[1])


@settings(max_examples=25)
@given(seed=SEEDS, yaw_deg=st.floats(15, 75), lateral_m=st.floats(-0.05, 0.05))
def test_upright_follows_two_visible_side_faces_within_two_degrees(seed: int, yaw_deg: float, lateral_m: float):
    rng = np.random.default_rng(seed)
    half = np.array([rng.uniform(0.02, 0.05), rng.uniform(0.04, 0.09), rng.uniform(0.02, 0.05)])
    cloud, R = make_upright_view(rng, half, np.deg2rad(yaw_deg), np.array([lateral_m, 0.0, 0.4]))
    cosine = np.abs(R.T @ fit_obb(cloud, up=UP).R_camera_box[:, 0]).max()
    # Over 1,200 such views: median 0.23°, 99 % within 1.4°, worst 1.8°
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 2.0


def test_a_round_footprint_gets_a_box_that_faces_the_camera():
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(-np.pi / 2, np.pi / 2, 4000), rng.uniform(-0.08, 0.08, 4000)
    cloud = np.stack([0.03 * np.sin(angle) + 0.1, height, 0.4 - 0.03 * np.cos(angle)], axis=1)
    box = fit_obb(cloud + rng.normal(0, 5e-4, cloud.shape), up=UP)
    toward_camera = -np.array([0.1, 0.0, 0.38]) / np.linalg.norm([0.1, 0.0, 0.38])
    assert box.R_camera_box[:, 0] @ toward_camera > np.cos(np.deg2rad(5))


@pytest.mark.parametrize("method", METHODS)
def test_one_visible_face_marks_the_view_axis_unobserved(method: FitMethod):
    cloud, _ = make_upright_view(np.random.default_rng(1), np.array([0.03, 0.08, 0.05]), 0.0, np.array([0, 0, 0.4]))
    box = fit_obb(cloud, method, up=UP)
    view_axis = int(np.argmax(np.abs(box.R_camera_box[2])))
    assert box.unobserved.tolist() == [axis == view_axis for axis in range(3)]
    assert box.extents_m[view_axis] < 0.006


def test_two_visible_faces_leave_no_axis_unobserved():
    cloud, _ = make_upright_view(np.random.default_rng(1), np.array([0.03, 0.08, 0.05]), 0.6, np.array([0, 0, 0.4]))
    assert not fit_obb(cloud, up=UP).unobserved.any()


def test_one_flying_pixel_does_not_stretch_the_box():
    points = make_solid(np.random.default_rng(2), np.array([0.03, 0.05, 0.09]), 2000) + np.array([0, 0, 0.4])
    for method in ("pca", "upright"):
        clean, dirty = fit_obb(points, method, up=UP), fit_obb(np.vstack([points, [0, 0, 0.7]]), method, up=UP)
        assert same_corners(clean.corners_m, dirty.corners_m) < 5e-3


@pytest.mark.parametrize("method", METHODS)
def test_a_planar_cloud_has_a_defined_thin_box(method: FitMethod):
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (200, 3)) * [1.0, 1.6, 0.0] + [0, 0, 0.4]
    box = fit_obb(points, method, up=UP)
    assert 1e-3 <= box.extents_m.min() + 1e-12 < 1.3e-3
    assert np.isfinite(box.T_camera_box).all()


BAD_CLOUDS = {
    "empty": np.zeros((0, 3)),
    "three points": np.eye(3),
    "one place": np.ones((50, 3)),
    "one line": np.linspace(0, 1, 50)[:, None] * [0.1, 0.2, 0.3],
    "nan": np.vstack([np.eye(3), np.eye(3), [[np.nan, 0, 0]]]),
    "infinite": np.vstack([np.eye(3), np.eye(3), [[np.inf, 0, 0]]]),
    "two columns": np.zeros((50, 2)),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("cloud", BAD_CLOUDS.values(), ids=BAD_CLOUDS)
def test_a_degenerate_cloud_raises_its_own_error(cloud: np.ndarray, method: FitMethod):
    with raises(DegenerateCloudError, "degenerate_cloud"):
        fit_obb(cloud, method, up=UP)


def test_unusable_arguments_are_rejected():
    points = make_solid(np.random.default_rng(0), np.full(3, 0.05))
    with raises(InvalidValueError, "up"):
        fit_obb(points, "upright")
    with raises(InvalidValueError, "up"):
        fit_obb(points, up=np.zeros(3))
    with raises(InvalidValueError, "box_method"):
        fit_obb(points, "minimum")  # pyright: ignore[reportArgumentType]
    with raises(InvalidValueError, "percentile"):
        fit_obb(points, percentile=(99, 1))
    with raises(InvalidValueError, "face_count"):
        nearest_faces(make_box(), 7)
    with raises(InvalidValueError, "alpha") as caught:
        rank_grasps(make_random_grasps(np.random.default_rng(0)), make_box(), alpha=1.5)
    assert "1.5" in str(caught.value) and "0 to 1" in str(caught.value)


def test_nearest_faces_are_those_with_the_nearest_true_centers():
    assert nearest_faces(make_box(), 1).tolist() == [5]
    assert nearest_faces(make_box(), 2, origin=np.array([0.5, 0.0, 0.4])).tolist()[0] == 0
    assert sorted(nearest_faces(make_box(), 6).tolist()) == [0, 1, 2, 3, 4, 5]


def test_the_unobserved_back_of_a_one_face_view_is_the_farthest_face():
    cloud, _ = make_upright_view(np.random.default_rng(1), np.array([0.03, 0.08, 0.05]), 0.0, np.array([0, 0, 0.4]))
    box = fit_obb(cloud, up=UP)
    faces = nearest_faces(box, 6)
    assert box.face_normals[faces[0]] @ [0, 0, 1] < -0.99
    assert box.face_normals[faces[-1]] @ [0, 0, 1] > 0.99


def test_alignment_keeps_exactly_the_grasps_above_zero():
    approaches = np.array([[0, 0, 1], [1, 0, 0], [0, 0, -1], [1, 0, 1e-6], [1, 0, -1e-6], [0, 1, 1]], dtype=float)
    ranked = rank_grasps(make_grasps(approaches, np.full(6, 0.5)), make_box(), k=1)
    assert ranked.indices.tolist() == [0, 5, 3]
    np.testing.assert_allclose(ranked.alignments, [1.0, np.sqrt(0.5), 1e-6], rtol=1e-9)


def test_the_combined_score_is_the_paper_formula():
    approaches = np.array([[0, 0, 1], [0, 1, 1], [0, 0, -1]], dtype=float)
    ranked = rank_grasps(make_grasps(approaches, np.array([0.2, 0.8, 0.95])), make_box(), k=1, alpha=0.85)
    high = 0.85 * np.sqrt(0.5) + 0.15 * 0.6 / (0.6 + 1e-6)
    np.testing.assert_allclose(ranked.scores, [0.85, high], rtol=1e-9)


@pytest.mark.integration
@settings(max_examples=30)
@given(seed=SEEDS, k=st.integers(1, 6), alpha=st.floats(0, 1))
def test_ranked_scores_never_rise_and_belong_to_their_grasps(seed: int, k: int, alpha: float):
    grasps = make_random_grasps(np.random.default_rng(seed))
    ranked = rank_grasps(grasps, make_box(), k=k, alpha=alpha)
    assert (np.diff(ranked.scores) <= 0).all()
    assert (ranked.alignments > 0).all() and len(ranked.faces) == k
    np.testing.assert_array_equal(ranked.grasps.T_camera_grasps, grasps.T_camera_grasps[ranked.indices])
    np.testing.assert_array_equal(ranked.grasps.scores, grasps.scores[ranked.indices])


@pytest.mark.integration
@settings(max_examples=20)
@given(seed=SEEDS)
def test_shuffling_the_grasps_does_not_change_the_ranking(seed: int):
    rng = np.random.default_rng(seed)
    grasps = make_random_grasps(rng)
    shuffled = rng.permutation(len(grasps))
    first, second = rank_grasps(grasps, make_box()), rank_grasps(grasps[shuffled], make_box())
    np.testing.assert_array_equal(first.indices, shuffled[second.indices])


def test_equal_grasps_keep_their_order():
    approaches = np.tile([[0.0, 0.0, 1.0]], (40, 1))
    assert rank_grasps(make_grasps(approaches, np.full(40, 0.3)), make_box()).indices.tolist() == list(range(40))
    assert rank_by_score(make_grasps(approaches, np.full(40, 0.3))).indices.tolist() == list(range(40))


def test_alpha_one_ranks_by_alignment_and_alpha_zero_by_score():
    grasps = make_random_grasps(np.random.default_rng(5))
    by_alignment = rank_grasps(grasps, make_box(), alpha=1.0)
    np.testing.assert_allclose(by_alignment.scores, by_alignment.alignments)
    by_score = rank_grasps(grasps, make_box(), alpha=0.0)
    assert (np.diff(by_score.grasps.scores) <= 0).all()


def test_a_ranking_by_other_scores_keeps_the_rows_together():
    ranked = rank_grasps(make_random_grasps(np.random.default_rng(7)), make_box())
    other = np.random.default_rng(8).random(len(ranked))
    again = ranked.reordered(other)
    assert (np.diff(again.scores) <= 0).all() and sorted(again.indices) == sorted(ranked.indices)
    place = {index: n for n, index in enumerate(ranked.indices)}
    order = [place[index] for index in again.indices]
    np.testing.assert_array_equal(again.scores, other[order])
    np.testing.assert_array_equal(again.alignments, ranked.alignments[order])
    np.testing.assert_array_equal(again.grasps.T_camera_grasps, ranked.grasps.T_camera_grasps[order])


def test_without_accepted_grasps_the_ranking_is_empty():
    backward = make_grasps(np.array([[0.0, 0.0, -1.0], [0.0, 0.1, -1.0]]), np.array([0.1, 0.9]))
    ranked = rank_grasps(backward, make_box(), k=1)
    assert len(ranked) == len(ranked.grasps) == len(ranked.scores) == len(ranked.alignments) == 0


def test_the_baseline_ranks_every_grasp_by_score_without_a_box():
    grasps = make_random_grasps(np.random.default_rng(6))
    ranked = rank_by_score(grasps)
    assert len(ranked) == len(grasps) and ranked.box is None and len(ranked.faces) == 0
    assert (np.diff(ranked.scores) <= 0).all() and np.isnan(ranked.alignments).all()
