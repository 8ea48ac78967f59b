"""Intrinsics: a known camera is recovered, bad views are rejected, weak sets of views give warnings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.board.detection import BoardView
from calibration.camera_model import CameraModel
from calibration.errors import CalibrationError
from calibration.intrinsics import calibrate_intrinsics
from calibration.report import write_report
from calibration.results import CalibrationResult, load_newest, save_result
from hal.base.transforms import transform_points
from tests.support.calibration_data import BOARD, CAMERA, sample_T_camera_board
from tests.support.errors import raises

TRUE = CameraModel(matrix=CAMERA.matrix, distortion=np.array([-0.05, 0.06, 1e-3, -5e-4, 0.0]), size=CAMERA.size)


def views(n: int, *, tilt_deg: float = 40.0, spread: float = 0.35, seed: int = 0) -> list[BoardView]:
    """Return views of a board that wanders over the image."""
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < n:
        T = sample_T_camera_board(rng, tilt_deg=tilt_deg, distance_m=(0.16, 0.3))
        T[:2, 3] += rng.uniform(-spread, spread, 2) * T[2, 3]
        pixels = TRUE.project(transform_points(T, BOARD.corners_m)) + rng.normal(0.0, 0.1, (35, 2))
        inside = ((pixels > 4.0) & (pixels < np.array(TRUE.size) - 4.0)).all(axis=1)
        if inside.sum() >= 15:
            ids = np.flatnonzero(inside)
            found.append(BoardView(ids=ids, pixels_px=pixels[ids], sharpness=0.6, image_size=TRUE.size))
    return found


@pytest.mark.integration
def test_the_camera_is_found_within_its_own_standard_deviations() -> None:
    result = calibrate_intrinsics(views(20), BOARD)
    matrix, true = result.camera.matrix, TRUE.matrix
    found = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *result.camera.distortion])
    wanted = np.array([true[0, 0], true[1, 1], true[0, 2], true[1, 2], *TRUE.distortion])
    assert (np.abs(found - wanted) < 4.0 * result.sd).all()
    assert abs(matrix[0, 0] - true[0, 0]) < 1.0
    assert result.rms_px < result.holdout_px < 0.2
    assert result.warnings == ()
    assert result.rejected == {}


def test_bad_view_is_rejected_with_its_reason() -> None:
    given = views(15)
    rng = np.random.default_rng(5)
    given[6] = replace(given[6], pixels_px=given[6].pixels_px + rng.normal(0.0, 3.0, given[6].pixels_px.shape))
    result = calibrate_intrinsics(given, BOARD, names=[f"v{i}" for i in range(15)])
    assert list(result.rejected) == ["v6"]
    assert "reprojection error" in result.rejected["v6"]
    assert result.rms_px < 0.2
    assert result.view_errors_px[6] > 1.0


def test_weak_sets_of_views_give_warnings() -> None:
    result = calibrate_intrinsics(views(7, spread=0.0, tilt_deg=14.0), BOARD)
    assert {"too_few_views", "little_tilt"} <= {warning.code for warning in result.warnings}


def test_views_in_one_corner_leave_the_coverage_poor() -> None:
    given = [replace(view, pixels_px=0.45 * view.pixels_px) for view in views(10)]
    result = calibrate_intrinsics(given, BOARD)
    assert "poor_coverage" in {warning.code for warning in result.warnings}
    assert result.coverage[:, 5:].sum() == 0


def test_parallel_views_are_rejected() -> None:
    with raises(CalibrationError, "too_similar_poses"):
        calibrate_intrinsics(views(8, tilt_deg=0.0), BOARD)


def test_too_few_views_and_mixed_sizes_are_rejected() -> None:
    with raises(CalibrationError, "too_few_views"):
        calibrate_intrinsics(views(4), BOARD)
    mixed = views(6)
    mixed[3] = replace(mixed[3], image_size=(1280, 720))
    with raises(CalibrationError, "bad_view"):
        calibrate_intrinsics(mixed, BOARD)


@pytest.mark.integration
def test_the_result_is_kept_and_reported(tmp_path: Path) -> None:
    result = calibrate_intrinsics(views(10), BOARD)
    calibration = CalibrationResult.of_intrinsics(
        result, serial="123", date="2026-11-22", board=BOARD, folder="samples"
    )
    save_result(tmp_path, calibration)
    again = load_newest(tmp_path, "intrinsics", "123")
    np.testing.assert_array_equal(again.camera.matrix, result.camera.matrix)
    write_report(tmp_path / "report.html", again, result, views=views(10))
    assert "k3" in (tmp_path / "report.html").read_text()
