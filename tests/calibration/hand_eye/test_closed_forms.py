"""Closed forms: exact samples give the exact camera, and outliers do not disturb the initial poses."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.hand_eye.closed_forms import estimate_initial_poses, solve_closed_forms, solve_park_martin
from calibration.pose_checks import pose_distances_mm_deg
from tests.support.calibration_data import T_BASE_BOARD, T_FLANGE_CAMERA
from tests.support.hand_eye_problems import make_problem

METHODS = ("tsai", "park", "horaud", "andreff", "daniilidis", "shah", "li")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("method", METHODS)
def test_each_method_recovers_the_camera_from_exact_samples(method: str, seed: int) -> None:
    data = make_problem(seed)
    found = dict(solve_closed_forms(data.Ts_anchor_mount, data.Ts_camera_board))
    mm, deg = pose_distances_mm_deg(found[method], T_FLANGE_CAMERA)
    assert mm < 1e-3
    assert deg < 1e-3


def test_own_method_agrees_with_opencvs_park() -> None:
    data = make_problem(3, arm_m=2e-4, arm_rad=3e-4)
    own = solve_park_martin(data.Ts_anchor_mount, data.Ts_camera_board)
    opencvs = dict(solve_closed_forms(data.Ts_anchor_mount, data.Ts_camera_board))["park"]
    np.testing.assert_allclose(own, opencvs, atol=2e-5)


@pytest.mark.parametrize("n_outliers", [0, 3, 5])
def test_initial_poses_ignore_outliers(n_outliers: int) -> None:
    data = make_problem(4)
    arm = data.Ts_anchor_mount.copy()
    arm[:n_outliers, :3, 3] += np.random.default_rng(0).uniform(0.05, 0.1, (n_outliers, 3))
    T_mount_camera, T_anchor_board, error_mm = estimate_initial_poses(arm, data.Ts_camera_board)
    assert pose_distances_mm_deg(T_mount_camera, T_FLANGE_CAMERA)[0] < 1e-3
    assert pose_distances_mm_deg(T_anchor_board, T_BASE_BOARD)[0] < 1e-3
    assert error_mm < 1e-3
