"""Scripts for pyrealsense2 and for the Z1's vendor module run unmodified on the twin."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

from hal.base.clock import ManualClock
from hal.z1_protocol.controller import LABELS
from scripts.commands.run_script import run_program
from scripts.support.script_windows import Windows, windows_as_files

SCRIPTS = Path(__file__).parent / "realsense_scripts"
UNITREE_SCRIPTS = Path(__file__).parent / "unitree_scripts"
FORWARD, START_FLAT = LABELS["forward"], LABELS["startFlat"]
needs_librealsense = pytest.mark.skipif(find_spec("pyrealsense2") is None, reason="pyrealsense2 has no wheel here")


def run_script(tmp_path: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-P", "-m", "scripts.cli", "twin", "run-script", f"--windows={tmp_path}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.integration
@needs_librealsense
def test_a_script_reads_distances_from_the_twin(tmp_path: Path) -> None:
    done = run_script(tmp_path, "--lockstep", "--distance-m=0.45", str(SCRIPTS / "distance.py"))
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    distances = [float(line.split()[1]) for line in lines[:10]]
    assert 0.2 < np.median(distances) < 0.35
    assert len(set(distances)) > 1  # noise
    assert lines[10] == "." * 32  # the far wall
    assert "#" in lines[16]


@pytest.mark.integration
@needs_librealsense
def test_a_viewer_with_options_of_its_own_shows_its_window_in_a_file(tmp_path: Path) -> None:
    viewer = str(SCRIPTS / "aligned_viewer.py")
    done = run_script(tmp_path, "--lockstep", "--frames=2", viewer, "--clip", "0.7")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        "Intel RealSense D405 000000000405",
        "usb 3.2",
        "product line D400",
        "depth scale 0.000100",
        "there and back True True",
    ]
    image = cv2.imread(str(tmp_path / "Aligned.png"))
    assert image is not None
    assert image.shape == (480, 1280, 3)
    assert (image[:60, :600] == 153).mean() > 0.9  # the background is removed
    assert (image[200:400, 200:400] != 153).mean() > 0.5
    assert f"its window is in {tmp_path / 'Aligned.png'}" in done.stderr


@pytest.mark.integration
@needs_librealsense
def test_a_script_filters_records_and_replays(tmp_path: Path) -> None:
    recording, cloud = tmp_path / "second.db3", tmp_path / "cloud.ply"
    script = str(SCRIPTS / "record_and_replay.py")
    done = run_script(tmp_path, "--lockstep", script, str(recording), str(cloud))
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[:2] == ["filtered (120, 212)", "colorized (240, 424, 3)"]
    assert lines[2].startswith("vertices 101760 0.")
    assert lines[3:] == ["played from Intel RealSense D405", "played True"]
    assert recording.stat().st_size > 1e6
    assert cloud.read_bytes().startswith(b"ply")


@pytest.mark.integration
@needs_librealsense
def test_a_script_for_the_vendors_module_calculates(tmp_path: Path) -> None:
    done = run_script(tmp_path, "--lockstep", str(UNITREE_SCRIPTS / "calculations.py"))
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        "any True True",
        "far False",
        "near True True",
        "twist True",
        "weight (6,) True",
        "limits 6 6 6",
        "protected True",
        "singular True True",
    ]


@pytest.mark.slow
@pytest.mark.integration
@needs_librealsense
def test_a_script_for_the_vendors_module_moves_the_arm_by_every_method(tmp_path: Path) -> None:
    done = run_script(tmp_path, "--start=startFlat", str(UNITREE_SCRIPTS / "tour.py"))
    assert done.returncode == 0, done.stderr
    printed = dict(re.split(r" (?=\[|True|False|[A-Z]{3}|\d)", line, maxsplit=1) for line in done.stdout.splitlines())
    numbers = {name: np.fromstring(text.strip("[]"), sep=" ") for name, text in printed.items() if text[0] == "["}
    assert numbers["forward"] == pytest.approx(FORWARD, abs=0.03)
    assert numbers["jogged"] == pytest.approx(FORWARD + 0.2 * np.eye(6)[0], abs=0.03)
    assert numbers["jogged to"] == pytest.approx([*numbers["jogged"], -0.2], abs=0.05)
    for name, y_m in (("MoveJ", -0.1), ("MoveL", 0.0), ("MoveC", 0.1)):
        assert printed[name] == "True"
        assert numbers[f"{name} to"] == pytest.approx([0, 0, 0, 0.45, y_m, 0.35], abs=0.02)
    assert printed["unreachable"] == "False"
    assert "is unreachable within the joint limits" in done.stderr
    assert (printed["CARTESIAN"], printed["down"]) == ("True", "True")
    assert numbers["sideways"] == pytest.approx([0, 0], abs=0.005)
    assert numbers["start"] == pytest.approx(START_FLAT, abs=0.03)
    assert (printed["passive"], printed["low level"], printed["end"]) == ("PASSIVE", "LOWCMD", "JOINTCTRL")
    assert numbers["low level to"] == pytest.approx([0.2, 0.6, -0.6, -0.1, 0, 0], abs=0.06)
    assert printed["motors"] == "8 0 0"


@pytest.mark.integration
@needs_librealsense
def test_in_lock_step_the_arm_is_fixed_and_a_script_gets_an_error(tmp_path: Path) -> None:
    script = tmp_path / "moves.py"
    script.write_text("import unitree_arm_interface as sdk\nsdk.ArmInterface(True).loopOn()\n")
    done = run_script(tmp_path, "--lockstep", str(script))
    assert done.returncode == 1
    assert "with --lockstep the twin's arm does not move" in done.stderr


def test_a_program_ends_as_under_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [])
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "neighbour.py").write_text("codes = {'seven': 7, 'text': 'failed', 'none': None}\n")
    script = tmp_path / "ends.py"
    script.write_text(
        "import sys, neighbour\nif __name__ == '__main__' and sys.argv[1:]: sys.exit(neighbour.codes[sys.argv[1]])"
    )
    assert [run_program(script, options) for options in (["seven"], ["text"], ["none"], [])] == [7, 1, 0, 0]
    assert capsys.readouterr().err == "failed\n"
    with pytest.raises(KeyError):
        run_program(script, ["other"])


@pytest.mark.integration
def test_a_missing_script_and_an_unknown_step_are_usage_errors(tmp_path: Path) -> None:
    done = run_script(tmp_path, "nowhere.py")
    assert (done.returncode, done.stderr) == (2, "error: there is no script nowhere.py.\n")
    command = [sys.executable, "-P", "-m", "scripts.cli", "twin", "run-scrip"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "run-script, wire; not 'run-scrip'" in done.stderr


def test_windows_keep_their_last_image_and_press_keys_at_the_end(tmp_path: Path) -> None:
    clock = ManualClock()
    windows = Windows(clock, frames=2)
    windows.show("Depth / raw", np.full((4, 6), 0.5))
    assert windows.wait_key(20) == -1
    assert clock.now_s() == pytest.approx(0.02)
    windows.show("Depth / raw", np.full((4, 6), 1.0))
    assert [windows.wait_key(1) for _ in range(3)] == [27, ord("q"), 27]
    (file,) = windows.save(tmp_path / "new")
    assert file.name == "Depth_raw.png"
    image = cv2.imread(str(file))
    assert image is not None
    assert (image == 255).all()


def test_opencvs_own_functions_are_restored(tmp_path: Path) -> None:
    before = cv2.waitKey
    with windows_as_files(tmp_path, ManualClock(), 1) as windows:
        if windows is None:
            pytest.skip("this OpenCV has windows of its own")
        cv2.imshow("x", np.zeros((2, 2, 3), np.uint8))
        assert cv2.waitKey(1) == 27
    assert cv2.waitKey is before
    assert (tmp_path / "x.png").is_file()
