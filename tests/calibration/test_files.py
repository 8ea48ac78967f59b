"""Samples, results and reports on disk: written atomically, never overwritten; damaged files are reported."""

from __future__ import annotations

import json
import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.files import write_new
from calibration.hand_eye.solver import solve_hand_eye
from calibration.report import write_report
from calibration.results import CalibrationResult, load_newest, load_result, save_result
from calibration.samples import CaptureInfo, Sample, load_samples, open_sample_folder, save_sample
from tests.support.calibration_data import BOARD, CAMERA, T_BASE_BOARD, T_FLANGE_CAMERA, record
from tests.support.errors import raises

SESSION = CaptureInfo(board=BOARD, serial="123", setup="eye_in_hand", camera=CAMERA, date="2026-11-22T10:00:00Z")
RESULT = CalibrationResult(
    kind="hand_eye",
    serial="123",
    date="2026-11-22T10:00:00Z",
    board=BOARD,
    camera=CAMERA,
    samples={"folder": "x", "used": ["0001"], "dropped": {}},
    errors={"uncertainty_mm": 0.3, "uncertainty_deg": 0.08},
    setup="eye_in_hand",
    T_mount_camera=T_FLANGE_CAMERA,
    T_anchor_board=T_BASE_BOARD,
    covariance=np.eye(6) * 1e-8,
)


def sample(seed: int) -> Sample:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 255, (480, 640, 3), dtype=np.uint8)
    return Sample(image=image, T_base_flange=T_FLANGE_CAMERA, q=rng.normal(size=7), stamp_s=float(seed))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    open_sample_folder(tmp_path / "s", SESSION)
    return tmp_path / "s"


@pytest.mark.integration
def test_samples_come_back_as_they_were_taken(folder: Path) -> None:
    assert [save_sample(folder, sample(i)) for i in range(3)] == ["0001", "0002", "0003"]
    loaded = load_samples(folder)
    assert loaded.names == ("0001", "0002", "0003")
    assert loaded.warnings == ()
    assert loaded.info.board == BOARD
    np.testing.assert_array_equal(loaded.samples[1].image, sample(1).image)
    np.testing.assert_array_equal(loaded.samples[1].q, sample(1).q)
    np.testing.assert_allclose(loaded.samples[1].T_base_flange, T_FLANGE_CAMERA, atol=1e-15)


@pytest.mark.integration
@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: (folder / "0002.json").write_text('{"format": 1, "q": ['),
        lambda folder: (folder / "0002.json").unlink(),
        lambda folder: (folder / "0002.png").write_bytes((folder / "0002.png").read_bytes()[:5000]),
        lambda folder: (folder / "0002.png").write_bytes((folder / "0001.png").read_bytes()),
        lambda folder: (folder / "0002.png").unlink(),
        lambda folder: (folder / "0002.json").write_text("[]"),
    ],
    ids=["cut json", "no json", "cut picture", "other picture", "no picture", "other json"],
)
def test_damaged_sample_gives_a_warning_and_is_left_unchanged(folder: Path, damage) -> None:
    for i in range(3):
        save_sample(folder, sample(i))
    damage(folder)
    before = sorted(folder.iterdir())
    loaded = load_samples(folder)
    assert loaded.names == ("0001", "0003")
    (warning,) = loaded.warnings
    assert warning.code == "damaged_sample"
    assert warning.samples == ("0002",)
    assert sorted(folder.iterdir()) == before
    assert save_sample(folder, sample(4)) == "0004"  # its number is not used again


def test_capture_is_continued_and_another_is_rejected(folder: Path) -> None:
    open_sample_folder(folder, replace(SESSION, date="2027-01-01"))
    assert load_samples(folder).info.date == SESSION.date
    with raises(CalibrationError, "other_session"):
        open_sample_folder(folder, replace(SESSION, serial="999"))


def test_invalid_folders_and_samples_are_rejected(tmp_path: Path, folder: Path) -> None:
    with raises(CalibrationError, "no_session"):
        load_samples(tmp_path)
    (tmp_path / "session.json").write_text("{}")
    with raises(CalibrationError, "no_session"):
        load_samples(tmp_path)
    with raises(CalibrationError, "bad_sample"):
        save_sample(folder, replace(sample(0), image=np.zeros((10, 10, 3), np.uint8)))
    with raises(CalibrationError, "bad_sample"):
        save_sample(folder, replace(sample(0), q=np.full(7, np.nan)))
    assert [path.name for path in folder.iterdir()] == ["session.json"]


def test_a_file_is_never_written_over_and_nothing_half_written_stays(tmp_path: Path) -> None:
    assert write_new(tmp_path / "a", b"first")
    assert not write_new(tmp_path / "a", b"second")
    assert (tmp_path / "a").read_bytes() == b"first"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_results_are_numbered_and_the_newest_is_loaded(tmp_path: Path) -> None:
    first = save_result(tmp_path, RESULT)
    second = save_result(tmp_path, replace(RESULT, date="2026-11-23"))
    assert (first.name, second.name) == ("hand_eye_123_v0001.json", "hand_eye_123_v0002.json")
    newest = load_newest(tmp_path, "hand_eye", "123")
    assert newest.path == second
    assert newest.date == "2026-11-23"
    assert newest.board == BOARD
    np.testing.assert_allclose(newest.T_flange_camera, T_FLANGE_CAMERA, atol=1e-15)
    np.testing.assert_array_equal(newest.covariance, RESULT.covariance)


def test_the_tenth_thousandth_is_newer_than_the_ninth(tmp_path: Path) -> None:
    (tmp_path / "hand_eye_123_v9999.json").write_bytes(save_result(tmp_path / "x", RESULT).read_bytes())
    assert save_result(tmp_path, replace(RESULT, date="later")).name == "hand_eye_123_v10000.json"
    assert load_newest(tmp_path, "hand_eye", "123").date == "later"


@pytest.mark.parametrize("content", ["", "{", "[]", '{"format": 2}', '{"format": 1, "kind": "hand_eye"}'])
def test_a_damaged_result_is_skipped_with_a_message(
    tmp_path: Path, content: str, caplog: pytest.LogCaptureFixture
) -> None:
    good = save_result(tmp_path, RESULT)
    (tmp_path / "hand_eye_123_v0002.json").write_text(content)
    assert load_newest(tmp_path, "hand_eye", "123").path == good
    assert "hand_eye_123_v0002.json" in caplog.text
    assert save_result(tmp_path, RESULT).name == "hand_eye_123_v0003.json"


def test_result_with_an_invalid_pose_is_damaged(tmp_path: Path) -> None:
    path = save_result(tmp_path, RESULT)
    values = json.loads(path.read_text())
    values["T_mount_camera"][0][0] = 2.0
    path.write_text(json.dumps(values))
    with raises(CalibrationError, "damaged_result"):
        load_result(path)


def test_result_of_another_camera_is_rejected(tmp_path: Path) -> None:
    path = save_result(tmp_path, RESULT)
    with raises(CalibrationError, "wrong_serial"):
        load_result(path, serial="456")
    with raises(CalibrationError, "missing_result"):
        load_newest(tmp_path, "hand_eye", "456")


def test_serial_with_the_same_file_name_is_rejected(tmp_path: Path) -> None:
    save_result(tmp_path, replace(RESULT, serial="a/b"))
    with raises(CalibrationError, "missing_result"):
        load_newest(tmp_path, "hand_eye", "a:b")


def test_result_and_its_quality_warnings_are_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    path = save_result(tmp_path, replace(RESULT, errors={"uncertainty_mm": 1.4, "uncertainty_deg": 0.08}))
    load_result(path)
    assert str(path) in caplog.text
    assert "uncertainty_mm is 1.4" in caplog.text


def test_an_eye_to_hand_result_has_no_camera_on_the_flange() -> None:
    with raises(CalibrationError, "wrong_setup"):
        _ = replace(RESULT, setup="eye_to_hand").T_flange_camera


def test_missing_folders_and_files_are_rejected(tmp_path: Path) -> None:
    with raises(CalibrationError, "missing_result"):
        load_newest(tmp_path / "none", "intrinsics", "123")
    with raises(CalibrationError, "missing_result"):
        load_result(tmp_path / "none.json")


@pytest.mark.integration
def test_report_has_plots_ground_truth_and_dropped_samples_in_one_file(tmp_path: Path) -> None:
    recording = record(0, 10)
    recording.Ts_base_flange[3, :3, 3] += 0.02
    result = solve_hand_eye(recording.Ts_base_flange, recording.Ts_camera_board, refine=recording.refine)
    calibration = CalibrationResult.of_hand_eye(
        result, serial="<123>", date="2026-11-22", board=BOARD, camera=CAMERA, folder="samples"
    )
    assert load_result(save_result(tmp_path, calibration)).samples["dropped"].keys() == {"4"}
    write_report(
        tmp_path / "report.html",
        calibration,
        result,
        views=recording.views,
        Ts_base_flange=recording.Ts_base_flange,
        ground_truth=T_FLANGE_CAMERA,
    )
    html = (tmp_path / "report.html").read_text()
    for words in (
        "Error against the ground truth",
        "before and after",
        "Spread of the rotations",
        "daniilidis",
        "left out: 4",
    ):
        assert words in html
    assert html.count("<svg") >= 5
    assert "&lt;123&gt;" in html
    assert "<123>" not in html
    assert not re.search(r"(src|href)=\"(?!#)", html)  # nothing is loaded from elsewhere
