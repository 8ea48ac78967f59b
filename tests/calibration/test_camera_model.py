"""Camera model: OpenCV's projection with its derivative, and rejected fields."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibration.camera_model import CameraModel
from calibration.errors import CalibrationError
from tests.support.calibration_data import CAMERA
from tests.support.errors import raises

DISTORTED = CameraModel(matrix=CAMERA.matrix, distortion=np.array([-0.06, 0.07, 1e-3, -5e-4, -0.02]), size=CAMERA.size)


def random_points(seed: int, n: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform((-0.1, -0.1, 0.2), (0.1, 0.1, 0.5), (n, 3))


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
def test_projection_equals_opencvs(camera: CameraModel) -> None:
    points = random_points(0, 50)
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-9)


def test_jacobian_is_the_derivative_of_the_projection() -> None:
    points = random_points(1, 20)
    _, jacobian = DISTORTED.project_with_jacobian(points)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        numeric = (DISTORTED.project(points + step) - DISTORTED.project(points - step)) / 2e-6
        np.testing.assert_allclose(jacobian[..., axis], numeric, rtol=1e-6, atol=1e-4)


def test_projection_is_invariant_to_the_length_of_a_ray() -> None:
    points = random_points(2, 20)
    np.testing.assert_allclose(DISTORTED.project(3.0 * points), DISTORTED.project(points), atol=1e-9)


def test_batches_keep_their_shape() -> None:
    points = random_points(3, 12)
    pixels, jacobian = DISTORTED.project_with_jacobian(points.reshape(3, 4, 3))
    np.testing.assert_array_equal(pixels.reshape(-1, 2), DISTORTED.project(points))
    assert jacobian.shape == (3, 4, 2, 3)


def test_camera_survives_its_dictionary() -> None:
    again = CameraModel.from_dict(DISTORTED.to_dict())
    np.testing.assert_array_equal(again.matrix, DISTORTED.matrix)
    np.testing.assert_array_equal(again.distortion, DISTORTED.distortion)
    assert again.size == DISTORTED.size


@pytest.mark.parametrize(
    "broken",
    [{"distortion": [0.0]}, {"size": [0, 480]}, {"size": [640]}, {"matrix": np.full((3, 3), np.nan).tolist()}],
    ids=["distortion", "empty image", "size", "nan"],
)
def test_broken_fields_are_rejected(broken: dict) -> None:
    with raises(CalibrationError, "bad_camera"):
        CameraModel.from_dict(DISTORTED.to_dict() | broken)
    with raises(CalibrationError, "bad_camera"):
        CameraModel.from_dict({})
