"""Board pose: exact views give the exact pose, and views without a pose are rejected."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.board.detection import BoardView
from calibration.board.pose import compute_rms_px, estimate_board_pose
from calibration.errors import CalibrationError
from calibration.pose_checks import pose_distances_mm_deg
from tests.support.calibration_data import BOARD, CAMERA, make_view, sample_T_camera_board
from tests.support.errors import raises


@pytest.mark.parametrize("seed", range(5))
def test_exact_view_gives_the_exact_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = sample_T_camera_board(rng)
    found = estimate_board_pose(make_view(T, rng, 0.0), BOARD, CAMERA)
    mm, deg = pose_distances_mm_deg(found.T_camera_board, T)
    assert mm < 1e-3
    assert deg < 1e-3
    assert found.rms_px < 1e-3


def test_view_with_two_possible_tilts_is_rejected() -> None:
    rng = np.random.default_rng(3)
    T = sample_T_camera_board(rng, tilt_deg=0.0, distance_m=(2.5, 2.5))
    T[:3, :3] = T[:3, :3] @ cv2.Rodrigues(np.radians([12.0, 0.0, 0.0]))[0]
    with raises(CalibrationError, "ambiguous_pose"):
        for _ in range(20):
            estimate_board_pose(make_view(T, rng, 0.5), BOARD, CAMERA)


def bad_views() -> dict[str, BoardView]:
    rng = np.random.default_rng(4)
    view = make_view(sample_T_camera_board(rng), rng, 0.0)
    row = np.flatnonzero(view.ids < 7)
    return {
        "few corners": replace(view, ids=view.ids[:4], pixels_px=view.pixels_px[:4]),
        "unknown ids": replace(view, ids=view.ids + 30),
        "other camera": replace(view, image_size=(1280, 720)),
        "one line": replace(view, ids=view.ids[row].repeat(2), pixels_px=view.pixels_px[row].repeat(2, axis=0)),
    }


@pytest.mark.parametrize("kind", bad_views())
def test_views_without_a_pose_are_rejected(kind: str) -> None:
    with raises(CalibrationError, "bad_view"):
        estimate_board_pose(bad_views()[kind], BOARD, CAMERA)


def test_rms_is_the_corner_distance() -> None:
    rng = np.random.default_rng(5)
    T = sample_T_camera_board(rng)
    view = make_view(T, rng, 0.0)
    shifted = replace(view, pixels_px=view.pixels_px + np.array([3.0, 4.0]))
    assert compute_rms_px(T, shifted, BOARD, CAMERA) == pytest.approx(5.0)
