"""Joint refinement: its Jacobian is the derivative of its residuals, and the noise of the corners is estimated."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.hand_eye.pose_fit import NoiseLevels, PoseData, PoseFit
from calibration.hand_eye.refinement import (
    _Bundle,
    estimate_corner_noise_px,
)
from hal.base.transforms import apply_increment
from tests.support.calibration_data import T_BASE_BOARD, T_FLANGE_CAMERA, Recording, record

NOISE = NoiseLevels(arm_m=1e-4, arm_rad=2e-4)


def problem_of(recording: Recording, *, camera_on_flange: bool = True) -> tuple[PoseData, PoseFit]:
    """Return the samples and a fit 1 mm and 3 mrad from the ground truth; without a camera on the flange, swapped."""
    n = len(recording.views)
    data = PoseData(
        Ts_anchor_mount=recording.Ts_base_flange,
        Ts_camera_board=recording.Ts_camera_board,
        corner_covariances=np.zeros((n, 6, 6)),
        camera_on_flange=camera_on_flange,
    )
    step = np.array([1e-3, -1e-3, 1e-3, 3e-3, 3e-3, -3e-3])
    fit = PoseFit(
        T_mount_camera=apply_increment(T_FLANGE_CAMERA, step),
        Ts_anchor_board=apply_increment(T_BASE_BOARD, -step)[None],
        board_index=np.zeros(n, int),
    )
    return data, fit


@pytest.mark.parametrize("camera_on_flange", [True, False])
def test_jacobian_is_the_derivative_of_the_residuals(camera_on_flange: bool) -> None:
    recording = record(1, 5)
    data, fit = problem_of(recording, camera_on_flange=camera_on_flange)
    bundle = _Bundle(recording.refine, data, fit, NOISE, np.arange(5))
    x = np.zeros(12 + 30)
    J = bundle.compute_jacobian(x)
    for column in range(len(x)):
        step = np.zeros(len(x))
        step[column] = 1e-7
        numeric = (bundle.residuals(step) - bundle.residuals(-step)) / 2e-7
        np.testing.assert_allclose(J[:, column], numeric, rtol=1e-4, atol=1e-4 * np.abs(J).max())


@pytest.mark.parametrize("corner_px", [0.05, 0.3])
def test_corner_noise_is_estimated(corner_px: float) -> None:
    recording = record(3, 12, corner_px=corner_px)
    found = estimate_corner_noise_px(recording.refine, recording.Ts_camera_board)
    assert found == pytest.approx(corner_px, rel=0.15)
