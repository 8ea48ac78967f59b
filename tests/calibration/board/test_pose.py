"""The board's pose in one view, and the camera model under it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.board.pose import estimate_board_pose
from calibration.camera_model import CameraModel
from calibration.errors import CalibrationError
from calibration.transforms import distance
from tests.support.calibration_data import BOARD, CAMERA, look_at_board, see

BENT = CameraModel(matrix=CAMERA.matrix, distortion=np.array([-0.06, 0.07, 1e-3, -5e-4, -0.02]), size=CAMERA.size)


def test_projection_is_opencvs() -> None:
    points = np.random.default_rng(0).uniform((-0.1, -0.1, 0.2), (0.1, 0.1, 0.5), (50, 3))
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), BENT.matrix, BENT.distortion)[0].reshape(-1, 2)
    np.testing.assert_allclose(BENT.project(points), theirs, atol=1e-9)


def test_the_slope_of_the_projection_is_its_derivative() -> None:
    points = np.random.default_rng(1).uniform((-0.1, -0.1, 0.2), (0.1, 0.1, 0.5), (20, 3))
    _, slope = BENT.project_with_slope(points)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        numeric = (BENT.project(points + step) - BENT.project(points - step)) / 2e-6
        np.testing.assert_allclose(slope[..., axis], numeric, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_an_exact_view_gives_the_exact_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = look_at_board(rng)
    found = estimate_board_pose(see(T, rng, 0.0), BOARD, CAMERA)
    mm, deg = distance(found.T_camera_board, T)
    assert mm < 1e-3
    assert deg < 1e-3
    assert found.rms_px < 1e-3


def test_a_view_that_both_tilts_explain_is_refused() -> None:
    rng = np.random.default_rng(3)
    T = look_at_board(rng, tilt_deg=0.0, distance_m=(2.5, 2.5))
    T[:3, :3] = T[:3, :3] @ cv2.Rodrigues(np.radians([12.0, 0.0, 0.0]))[0]
    with pytest.raises(CalibrationError, match="mirror") as error:
        for _ in range(20):
            estimate_board_pose(see(T, rng, 0.5), BOARD, CAMERA)
    assert error.value.code == "ambiguous_pose"


def test_views_that_give_no_pose_are_refused() -> None:
    rng = np.random.default_rng(4)
    view = see(look_at_board(rng), rng, 0.0)
    line = np.flatnonzero(view.ids < 7)
    for bad, says in (
        (replace(view, ids=view.ids[:4], pixels_px=view.pixels_px[:4]), "at least 8"),
        (replace(view, ids=view.ids + 30), "0 … 34"),
        (replace(view, image_size=(1280, 720)), "1280"),
        (replace(view, ids=view.ids[line].repeat(2), pixels_px=view.pixels_px[line].repeat(2, axis=0)), "one line"),
    ):
        with pytest.raises(CalibrationError, match=says) as error:
            estimate_board_pose(bad, BOARD, CAMERA)
        assert error.value.code == "bad_view"


def test_a_camera_survives_its_dictionary_and_a_broken_one_is_refused() -> None:
    again = CameraModel.from_dict(BENT.to_dict())
    np.testing.assert_array_equal(again.matrix, BENT.matrix)
    np.testing.assert_array_equal(again.distortion, BENT.distortion)
    for broken in ({}, BENT.to_dict() | {"distortion": [0.0]}, BENT.to_dict() | {"size": [0, 480]}):
        with pytest.raises(CalibrationError):
            CameraModel.from_dict(broken)
