"""The networks' input: view frame, number of points, normals."""

import numpy as np
import pytest

from models.diffusion.cloud import N_POINTS, find_view_frame, prepare_cloud


def make_box_front(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform([-0.03, -0.08, 0.39], [0.05, 0.08, 0.40], (900, 3))


def rotate(points: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    R = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    return points @ R.T, R


def test_the_view_frame_turns_with_the_camera():
    points = make_box_front(np.random.default_rng(0))
    T = find_view_frame(points)
    moved, R = rotate(points, 1)
    assert find_view_frame(moved)[:3, :3] == pytest.approx(R @ T[:3, :3], abs=1e-6)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert T[:3, 2] @ T[:3, 3] == pytest.approx(np.linalg.norm(T[:3, 3]))


@pytest.mark.parametrize("count", [30, 400, 5000])
def test_any_number_of_points_gives_the_networks_number(count):
    rng = np.random.default_rng(0)
    cloud = prepare_cloud(rng.uniform([-0.03, -0.08, 0.39], [0.05, 0.08, 0.40], (count, 3)), rng)
    assert cloud.points.shape == cloud.normals.shape == (N_POINTS, 3)
    assert np.linalg.norm(cloud.normals, axis=1) == pytest.approx(1.0)
