"""Which hand-eye transform is in force: the file given, else the newest of this camera, else the mount's drawing."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from calibration.board.board import Board
from calibration.camera_model import CameraModel
from calibration.results import MAX_UNCERTAINTY_MM, CalibrationResult, save_result
from hal.base import z1
from hal.base.errors import ConfigError
from z1_runtime.perception.extrinsics import find_extrinsics, results_folder

CAMERA = CameraModel.pinhole(fx=390.0, fy=390.0, cx=320.0, cy=240.0, width=640, height=480)
ERRORS = dict.fromkeys(("rms_mm", "rms_deg", "holdout_mm", "holdout_deg", "diversity"), 0.1)


def keep(folder: Path, serial: str, shift_m: float, *, uncertainty_mm: float = 0.1, **changes) -> Path:
    """Save a hand-eye result `shift_m` off the drawing's extrinsics."""
    T_flange_camera = z1.T_FLANGE_CAMERA.copy()
    T_flange_camera[0, 3] += shift_m
    fields = {
        "kind": "hand_eye",
        "serial": serial,
        "date": "2026-01-01T00:00:00+00:00",
        "board": Board(),
        "camera": CAMERA,
        "samples": {"folder": "somewhere", "used": [], "dropped": {}},
        "errors": {**ERRORS, "uncertainty_mm": uncertainty_mm, "uncertainty_deg": 0.01},
        "setup": "eye_in_hand",
        "T_mount_camera": T_flange_camera,
        "T_anchor_board": np.eye(4),
        "covariance": 1e-8 * np.eye(6),
    }
    return save_result(folder, CalibrationResult(**{**fields, **changes}))


def shift_m(T_flange_camera: np.ndarray) -> float:
    return float(T_flange_camera[0, 3] - z1.T_FLANGE_CAMERA[0, 3])


def test_the_newest_of_this_camera_is_used_with_a_message(tmp_path: Path):
    keep(tmp_path, "A", 0.001)
    newest = keep(tmp_path, "A", 0.002)
    keep(tmp_path, "B", 0.003)
    mount = find_extrinsics("A", folder=tmp_path)
    assert shift_m(mount.T_flange_camera) == pytest.approx(0.002)
    assert str(newest) in mount.origin and "camera A" in mount.origin and "±0.10 mm" in mount.origin


def test_a_damaged_newest_result_is_skipped(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    keep(tmp_path, "A", 0.001)
    newest = keep(tmp_path, "A", 0.002)
    newest.write_text(newest.read_text()[:100])
    with caplog.at_level(logging.WARNING):
        assert shift_m(find_extrinsics("A", folder=tmp_path).T_flange_camera) == pytest.approx(0.001)
    assert newest.name in caplog.text


def test_without_a_result_of_this_camera_the_drawing_is_used_with_a_message(tmp_path: Path):
    keep(tmp_path, "B", 0.003)
    for serial, text in (("A", "camera A"), ("", "no serial number")):
        mount = find_extrinsics(serial, folder=tmp_path)
        assert np.array_equal(mount.T_flange_camera, z1.T_FLANGE_CAMERA)
        assert "drawing" in mount.origin and text in mount.origin and str(tmp_path) in mount.origin
    assert "drawing" in find_extrinsics("A", folder=tmp_path / "missing").origin


def test_a_file_of_another_camera_is_rejected_with_both_serials(tmp_path: Path):
    with pytest.raises(ConfigError) as caught:
        find_extrinsics("A", keep(tmp_path, "B", 0.003), tmp_path)
    assert "B" in str(caught.value) and "A" in str(caught.value)


def test_a_file_is_taken_even_where_there_is_a_newer_one(tmp_path: Path):
    older = keep(tmp_path, "A", 0.001)
    keep(tmp_path, "A", 0.002)
    assert shift_m(find_extrinsics("A", older, tmp_path).T_flange_camera) == pytest.approx(0.001)


def test_files_that_are_no_hand_eye_result_of_a_wrist_camera_are_rejected(tmp_path: Path):
    damaged = tmp_path / "damaged.json"
    damaged.write_text("{}")
    other_setup = keep(tmp_path, "A", 0.0, setup="eye_to_hand")
    none = {"setup": None, "T_mount_camera": None, "T_anchor_board": None, "covariance": None}
    lens = keep(tmp_path, "A", 0.0, kind="intrinsics", errors={"rms_px": 0.1}, **none)
    for file in (damaged, tmp_path / "missing.json", other_setup, lens):
        with pytest.raises(ConfigError) as caught:
            find_extrinsics("A", file, tmp_path)
        assert str(file) in str(caught.value)


def test_an_uncertain_result_is_used_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.WARNING):
        find_extrinsics("A", keep(tmp_path, "A", 0.001, uncertainty_mm=0.9 * MAX_UNCERTAINTY_MM), tmp_path)
        assert not caplog.records
        mount = find_extrinsics("A", keep(tmp_path, "A", 0.002, uncertainty_mm=2.5 * MAX_UNCERTAINTY_MM), tmp_path)
    assert shift_m(mount.T_flange_camera) == pytest.approx(0.002)
    assert "uncertainty_mm" in caplog.text and "calibrate again" in caplog.text


def test_results_are_kept_in_the_user_s_data_by_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("Z1_CALIBRATIONS", str(tmp_path / "named"))
    assert results_folder(tmp_path / "given") == tmp_path / "given"
    assert results_folder() == tmp_path / "named"
    monkeypatch.delenv("Z1_CALIBRATIONS")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "xdg"))
    assert results_folder() == tmp_path / "xdg" / "z1-grasp" / "calibrations"
    monkeypatch.delenv("XDG_DATA_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert results_folder() == tmp_path / ".local" / "share" / "z1-grasp" / "calibrations"
