"""Hand-eye problems as poses, with exact ground truth or with a known noise."""

from __future__ import annotations

import numpy as np

from calibration.hand_eye.pose_fit import PoseData, PoseFit
from hal.base.transforms import apply_increment, inverse
from tests.support.calibration_data import T_BASE_BOARD, T_FLANGE_CAMERA, sample_T_camera_board


def true_fit(n: int) -> PoseFit:
    """Return the ground truth of n samples."""
    return PoseFit(T_mount_camera=T_FLANGE_CAMERA, Ts_anchor_board=T_BASE_BOARD[None], board_index=np.zeros(n, int))


def make_problem(
    seed: int, n: int = 15, *, arm_m: float = 0.0, arm_rad: float = 0.0, camera_on_flange: bool = True
) -> PoseData:
    """Return n samples, whose arm poses scatter in the flange's axes."""
    rng = np.random.default_rng(seed)
    Ts_camera_board = np.array([sample_T_camera_board(rng) for _ in range(n)])
    Ts_anchor_mount = T_BASE_BOARD @ inverse(Ts_camera_board) @ inverse(T_FLANGE_CAMERA)
    noise = rng.normal(size=(n, 6)) * np.repeat([arm_m, arm_rad], 3)
    if camera_on_flange:
        Ts_anchor_mount = apply_increment(Ts_anchor_mount, noise)
    else:  # the flange is the anchor
        Ts_anchor_mount = inverse(apply_increment(inverse(Ts_anchor_mount), noise))
    return PoseData(
        Ts_anchor_mount=Ts_anchor_mount,
        Ts_camera_board=Ts_camera_board,
        corner_covariances=np.zeros((n, 6, 6)),
        camera_on_flange=camera_on_flange,
    )
