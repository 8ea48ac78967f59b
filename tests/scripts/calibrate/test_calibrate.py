"""Calibration on the command line: capture, solve, verify, use; on the twin, against its ground truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calibration.board.board import Board
from calibration.board.detection import detect_board
from calibration.results import load_newest, load_result
from calibration.samples import load_samples
from hal.base.transforms import pose_error
from scripts import cli
from scripts.calibrate.verify_hand_eye import Config, main
from scripts.support.calibration_robot import RobotOptions, open_robot
from sim_twin.model.scene import SceneConfig

pytestmark = pytest.mark.integration

MOUNT = SceneConfig(mount_error_m=0.005, mount_error_deg=2.0, mount_seed=1)
OPTIONS = ("--mount-error-m=0.005", "--mount-error-deg=2", "--mount-seed=1")


@pytest.fixture(scope="module")
def calibrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of results after one hand-eye calibration of the twin."""
    folder = tmp_path_factory.mktemp("calibrations")
    arguments = [f"--calibrations={folder}", f"--out={folder / 'samples'}", "--poses=10", "--speed=1"]
    assert cli.main(["calibrate", "hand-eye", *arguments, *OPTIONS]) == 0
    return folder


def result_of(folder: Path) -> Path:
    (path,) = folder.glob("hand_eye_*_v0001.json")
    return path


def test_twin_is_calibrated_and_the_uncertainty_covers_the_error(calibrations: Path):
    found = load_newest(calibrations, "hand_eye", MOUNT.camera_serial())
    error_m, error_rad = pose_error(MOUNT.T_flange_camera(), found.T_flange_camera)
    assert 1e3 * error_m < min(0.2, found.errors["uncertainty_mm"])
    assert np.rad2deg(error_rad) < min(0.05, found.errors["uncertainty_deg"])
    assert found.path == result_of(calibrations)


def test_report_and_recording_are_saved_with_the_result(calibrations: Path):
    result = result_of(calibrations)
    report = result.with_suffix(".html").read_text()
    assert "ground truth" in report and MOUNT.camera_serial() in report
    assert result.with_suffix(".rrd").stat().st_size > 100_000


def test_samples_are_solved_again_offline_into_a_new_version(calibrations: Path, tmp_path: Path):
    before = result_of(calibrations).read_bytes()
    arguments = [f"--samples={calibrations / 'samples'}", f"--calibrations={calibrations}"]
    try:
        assert cli.main(["calibrate", "hand-eye", *arguments]) == 0
        (second,) = calibrations.glob("hand_eye_*_v0002.json")
        assert result_of(calibrations).read_bytes() == before
        first = load_result(result_of(calibrations))
        assert np.allclose(load_result(second).T_flange_camera, first.T_flange_camera, atol=1e-12)
    finally:
        for path in calibrations.glob("hand_eye_*_v0002.*"):
            path.unlink()


def test_a_damaged_sample_is_named_and_the_others_are_solved(calibrations: Path, tmp_path: Path, capfd):
    samples = tmp_path / "samples"
    samples.mkdir()
    for path in (calibrations / "samples").iterdir():
        (samples / path.name).write_bytes(path.read_bytes())
    name = load_samples(samples).names[2]
    (samples / f"{name}.png").write_bytes(b"not a picture")
    assert cli.main(["calibrate", "hand-eye", f"--samples={samples}", f"--calibrations={tmp_path}"]) == 0
    assert f"damaged_sample ({name})" in capfd.readouterr().out
    assert name not in load_result(next(tmp_path.glob("hand_eye_*.json"))).samples["used"]


def test_intrinsics_are_found_from_the_same_samples(calibrations: Path, tmp_path: Path):
    arguments = [f"--samples={calibrations / 'samples'}", f"--calibrations={tmp_path}"]
    assert cli.main(["calibrate", "intrinsics", *arguments]) == 0
    found = load_newest(tmp_path, "intrinsics", MOUNT.camera_serial())
    stated = load_samples(calibrations / "samples").info.camera
    assert np.abs(found.camera.matrix - stated.matrix).max() < 4.0  # ten views: no more than 1 %
    assert "<svg" in next(tmp_path.glob("intrinsics_*.html")).read_text()


def test_tip_check_passes_with_the_result_and_not_without(calibrations: Path, tmp_path: Path):
    out = tmp_path / "tips.json"
    arguments = ["calibrate", "verify", f"--out={out}", "--corners=2", "--speed=1", *OPTIONS]
    assert cli.main([*arguments, f"--calibrations={calibrations}"]) == 0
    passed = json.loads(out.read_text())
    assert passed["passed"] and passed["max_mm"] < 1.5 and "hand_eye" in passed["calibration"]
    assert len(passed["corners"]) == 2
    assert cli.main([*arguments, f"--calibrations={tmp_path}"]) == 1
    failed = json.loads(out.read_text())
    assert not failed["passed"] and failed["max_mm"] > 4.0 and "drawing" in failed["calibration"]


def test_on_a_real_arm_the_operator_types_the_offsets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from scripts.calibrate import verify_hand_eye

    def without_ground_truth(*arguments):
        return _NoGroundTruth(open_robot(*arguments))

    monkeypatch.setattr(verify_hand_eye, "open_robot", without_ground_truth)
    answers = iter(["what?", "0.5 -1.2", "", "3 0"])
    config = Config(out=tmp_path / "tips.json", corners=3, speed=1.0, calibrations=tmp_path, robot=RobotOptions())
    assert main(config, ask=lambda _: next(answers)) == 1
    measured = json.loads(config.out.read_text())
    assert [row["offset_mm"] for row in measured["corners"]] == [[0.5, -1.2, 0.0], [3.0, 0.0, 0.0]]
    assert not measured["passed"] and measured["max_mm"] == 3.0


class _NoGroundTruth:
    """A robot without ground truth."""

    def __init__(self, robot) -> None:
        self._robot = robot

    def __enter__(self):
        from dataclasses import replace

        return replace(self._robot.__enter__(), ground_truth=None)

    def __exit__(self, *error) -> None:
        self._robot.__exit__(*error)


# --- Use by the demo ------------------------------------------------------------------------------


def test_demo_reports_its_calibration_and_lifts_with_it(calibrations: Path, tmp_path: Path, capfd):
    arguments = ["demo", "--lockstep", f"--out={tmp_path}", f"--calibration={result_of(calibrations)}", *OPTIONS]
    assert cli.main(arguments) == 0
    assert str(result_of(calibrations)) in capfd.readouterr().out


def test_demo_rejects_the_calibration_of_another_camera(calibrations: Path, tmp_path: Path, capfd):
    arguments = ["demo", "--lockstep", f"--out={tmp_path}", f"--calibration={result_of(calibrations)}"]
    assert cli.main(arguments) == 2
    error = capfd.readouterr().err
    assert MOUNT.camera_serial() in error and len(error.strip().splitlines()) == 1


# --- The other commands -------------------------------------------------------------------------------


def test_a_board_is_written_that_the_detector_reads(tmp_path: Path):
    options = ["--columns=7", "--rows=5", "--square-m=0.03", "--marker-m=0.022"]
    assert cli.main(["calibrate", "board", f"--out={tmp_path / 'board.png'}", *options]) == 0
    page = np.asarray(Image.open(tmp_path / "board.png").convert("L"))
    small = np.asarray(Image.fromarray(page).resize((page.shape[1] // 2, page.shape[0] // 2)))
    view = detect_board(small, Board(columns=7, rows=5, square_m=0.03, marker_m=0.022))
    assert len(view.ids) == 6 * 4


@pytest.fixture
def in_a_new_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("Z1_CALIBRATIONS", str(tmp_path))


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["board", "--columns=60"], 1, "180 markers"),
        (["hand-eye", "--samples=missing"], 2, "missing"),
        (["intrinsics", "--samples=missing"], 2, "missing"),
        (["capture", "--board-x-m=2"], 2, "x_m is out of reach (2.0"),
        (["capture", "--poses=0"], 2, "poses 0"),
        (["capture", "--speed=7"], 2, "speed 7.0"),
        (["verify", "--height-m=0"], 2, "height_m 0.0"),
        (["verify", "--calibration=missing.json"], 2, "missing.json"),
    ],
)
def test_bad_input_is_one_clear_error(in_a_new_folder, capfd, arguments: list[str], code: int, text: str):
    assert cli.main(["calibrate", *arguments]) == code
    error = capfd.readouterr().err
    assert error.startswith("error: ") and text in error and len(error.strip().splitlines()) == 1
