"""The voxel index equals brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hal.base.errors import InvalidValueError
from tests.support.errors import raises
from z1_runtime.collision.voxel_grid import MAX_THRESHOLD_M, SceneIndex


def random_poses(n: int, rng: np.random.Generator, reach_m: float) -> np.ndarray:
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.random(n, rng=rng).as_matrix()
    T[:, :3, 3] = rng.uniform(-reach_m, reach_m, (n, 3))
    return T


@pytest.mark.parametrize("seed", range(12))
def test_random_clouds_have_the_contacts_of_brute_force(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.2, 0.2, (int(rng.integers(1, 4000)), 3))
    vertices = rng.uniform(-0.05, 0.05, (80, 3))
    T = random_poses(60, rng, 0.28)
    threshold = float(rng.uniform(0.001, 0.010))
    moved = np.einsum("nij,vj->nvi", T[:, :3, :3], vertices) + T[:, None, :3, 3]
    distance = cKDTree(points).query(moved.reshape(-1, 3))[0].reshape(60, 80)
    index = SceneIndex(points)
    hit_vertex, hit_point = index.first_hits(T, vertices, threshold)
    assert ((hit_vertex >= 0) == (distance.min(axis=1) <= threshold)).all()
    assert (index.collides(T, vertices, threshold) == (hit_vertex >= 0)).all()
    for n in np.flatnonzero(hit_vertex >= 0):
        assert np.linalg.norm(moved[n, hit_vertex[n]] - points[hit_point[n]]) <= threshold
    assert (index.near(moved[0], threshold) == (distance[0] <= threshold)).all()


def test_the_paper_s_threshold_is_kept_to_a_micrometre():
    index = SceneIndex(np.array([[0.0, 0.0, 0.0]]))
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, 0, 3] = [0.001999, 0.002001]
    assert index.collides(T, np.zeros((1, 3)), 0.002).tolist() == [True, False]


def test_an_empty_cloud_is_never_hit():
    index = SceneIndex(np.empty((0, 3)))
    assert not index.collides(np.eye(4)[None], np.zeros((5, 3)), 0.002).any()
    assert not index.near(np.zeros((5, 3)), 0.002).any()


@pytest.mark.integration
@settings(max_examples=150)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 60),
    st.sampled_from([0.0005, 0.004, 0.032, 0.3]),
    st.floats(0.0, MAX_THRESHOLD_M),
    st.floats(MAX_THRESHOLD_M, 0.05),
)
def test_equals_brute_force_at_every_density_threshold_and_pose(seed, n, extent_m, threshold_m, max_threshold_m):
    """Clouds within a cell, at cell and block borders, and sparse ones; the grid's 4 mm cells attract the points."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-extent_m, extent_m, (n, 3))
    points[::2] = np.round(points[::2] / 0.004) * 0.004
    vertices = rng.uniform(-extent_m, extent_m, (8, 3))
    T = random_poses(6, rng, 1.2 * extent_m)
    moved = np.einsum("nij,vj->nvi", T[:, :3, :3], vertices) + T[:, None, :3, 3]
    distance = np.linalg.norm(moved[:, :, None] - points, axis=3)
    index = SceneIndex(points, max_threshold_m)
    for threshold in (threshold_m, max_threshold_m):
        clear_cut = np.abs(distance - threshold).min() > 1e-12  # else rounding decides
        if clear_cut:
            hits = (distance <= threshold).any(axis=(1, 2))
            np.testing.assert_array_equal(index.collides(T, vertices, threshold), hits)
            near = (distance[0] <= threshold).any(axis=1)
            np.testing.assert_array_equal(index.near(moved[0], threshold), near)


def test_points_that_are_not_finite_and_thresholds_too_large_are_rejected():
    with raises(InvalidValueError, "not_finite"):
        SceneIndex(np.array([[0.0, np.nan, 0.0]]))
    index = SceneIndex(np.zeros((1, 3)))
    with raises(InvalidValueError, "threshold") as caught:
        index.collides(np.eye(4)[None], np.zeros((1, 3)), 0.02)
    assert "0.02 m" in str(caught.value)
    assert "0 to 0.01 m" in str(caught.value)
    with raises(InvalidValueError, "threshold"):
        index.near(np.zeros((1, 3)), 0.02)
