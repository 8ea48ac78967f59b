"""Sweeps over the faces of a box: on boxes and cylinders, and on clouds without grasps."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from hal.base.errors import InvalidValueError, Z1Error
from hal.base.transforms import inverse
from models.diffusion.training.grippers import GRIPPERS
from models.diffusion.training.labels import check_grasps
from models.diffusion.training.shapes import make_shape
from models.diffusion.training.views import ViewConfig, render_view
from models.obb.obb import DegenerateCloudError
from models.samplers.obb_sweep import ObbSweepConfig, ObbSweepSampler, fit_tightest_box
from tests.support.errors import raises

HALF = np.array([0.03, 0.09, 0.05])
CENTER = np.array([0.02, -0.01, 0.45])


def corner_view(yaw_rad: float = 0.6, n: int = 3000, seed: int = 0) -> np.ndarray:
    """Return two side faces (n, 3) of an upright box, turned by `yaw_rad`, seen from the height of its middle."""
    rng = np.random.default_rng(seed)
    on_first = rng.random(n) < 0.5
    local = rng.uniform(-HALF, HALF, (n, 3))
    local[on_first, 2] = -HALF[2]
    local[~on_first, 0] = HALF[0]
    return local @ yaw(yaw_rad).T + CENTER + rng.normal(0.0, 3e-4, (n, 3))


def yaw(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


@pytest.mark.parametrize("n", [1, 7, 800])
def test_exactly_the_requested_number_of_rigid_grasps_is_returned(n: int):
    grasps = ObbSweepSampler().sample(corner_view(), n, seed=3)
    R = grasps.T_camera_grasps[:, :3, :3]
    assert len(grasps) == n
    np.testing.assert_allclose(R.transpose(0, 2, 1) @ R, np.tile(np.eye(3), (n, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    assert (np.diff(grasps.scores) <= 0.0).all()
    assert grasps.scores.min() >= 0.0 and grasps.scores.max() <= 1.0
    assert grasps.widths_m.min() > 0.0 and grasps.widths_m.max() <= ObbSweepConfig().max_width_m


def test_the_same_seed_gives_the_same_grasps_and_another_seed_others():
    cloud, sampler = corner_view(), ObbSweepSampler()
    first, again, other = (sampler.sample(cloud, 100, seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.T_camera_grasps, again.T_camera_grasps)
    np.testing.assert_array_equal(first.scores, again.scores)
    assert not np.allclose(first.T_camera_grasps, other.T_camera_grasps)


def test_two_side_faces_give_a_box_along_them_and_not_along_their_hypotenuse():
    box = fit_tightest_box(corner_view())
    cosines = np.abs(box.R_camera_box.T @ yaw(0.6))
    assert cosines.max(axis=0).min() > np.cos(np.deg2rad(2.0))


def test_jaws_close_across_the_box_with_a_finger_on_either_side():
    grasps = ObbSweepSampler().sample(corner_view(), 400, seed=0)
    closing = np.abs(np.einsum("nij,ik->njk", grasps.T_camera_grasps[:, :3, :3], yaw(0.6)))[:, 1]
    assert (closing.max(axis=1) > np.cos(np.deg2rad(4.0))).all()
    across = np.argmax(closing, axis=1)
    assert np.abs(grasps.widths_m - 2.0 * HALF[across]).max() < 4e-3
    assert (across != 1).all()  # 180 mm high: no jaw closes over it
    local = (grasps.T_camera_grasps[:, :3, 3] - CENTER) @ yaw(0.6)
    assert np.abs(local[np.arange(400), across]).max() < 3e-3


def test_the_sweep_reaches_all_of_a_face_and_many_depths():
    grasps = ObbSweepSampler().sample(corner_view(), 400, seed=0)
    local = (grasps.T_camera_grasps[:, :3, 3] - CENTER) @ yaw(0.6)
    assert np.ptp(local[:, 1]) > 0.9 * 2.0 * HALF[1]
    assert np.ptp(local[:, 2]) > 0.04


def test_no_grasp_approaches_from_behind():
    grasps = ObbSweepSampler().sample(corner_view(), 400, seed=0)
    assert grasps.T_camera_grasps[:, 2, 2].min() > -0.8


@pytest.mark.integration
def test_most_grasps_of_boxes_and_cylinders_are_valid():
    valid = []
    for seed in range(6):
        rng = np.random.default_rng(500 + seed)
        solid = make_shape(("box", "cylinder")[seed % 2], rng)
        view = render_view(solid, ViewConfig(occluded_view_ratio=0.0), rng)
        assert view is not None
        points, T_camera_object = view
        grasps = ObbSweepSampler().sample(points, 150, 0)
        check = check_grasps(solid, inverse(T_camera_object) @ grasps.T_camera_grasps, GRIPPERS["agnostic"])
        valid.append(check.valid.mean())
    assert np.mean(valid) > 0.75


BAD_CLOUDS = {
    "empty": (np.zeros((0, 3)), InvalidValueError, "cloud_points"),
    "nan": (np.vstack([corner_view(), [[np.nan, 0.0, 0.4]]]), InvalidValueError, "cloud_not_finite"),
    "millimetres": (1000.0 * corner_view(), InvalidValueError, "cloud_extent"),
    "one place": (np.full((100, 3), 0.4), InvalidValueError, "cloud_extent"),
    "on a line": (np.linspace([0.0, 0.0, 0.4], [0.1, 0.0, 0.4], 100), DegenerateCloudError, "degenerate_cloud"),
    "too wide": (corner_view() * 3.0, InvalidValueError, "no_grasps"),
}


@pytest.mark.parametrize(("cloud", "kind", "code"), BAD_CLOUDS.values(), ids=BAD_CLOUDS)
def test_a_cloud_without_grasps_is_rejected(cloud: np.ndarray, kind: type[Z1Error], code: str):
    with raises(kind, code):
        ObbSweepSampler().sample(cloud, 100, seed=0)


def test_unusable_settings_and_counts_are_rejected():
    with raises(InvalidValueError, "gripper_depth"):
        ObbSweepConfig(max_depth_m=0.08)
    with raises(InvalidValueError, "sampling"):
        ObbSweepConfig(oversampling=0.5)
    with raises(InvalidValueError, "grasp_count"):
        ObbSweepSampler().sample(corner_view(), 0, seed=0)


@pytest.mark.integration
def test_it_needs_neither_torch_nor_numba():
    code = "import sys, models.samplers.obb_sweep; sys.exit(bool({'torch', 'numba'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
