"""Damaged and hostile files of users: every one ends in one line, soon, and with exit code 2."""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import CalibrationFileError
from calibration.results import FORMAT, load_result
from hal.backends.replay_camera import RecordingError, load_frames, make_demo_frames, save_frames
from hal.base.errors import ConfigError, UsageError
from hal.base.files import read_npz, read_yaml
from models.weights_file import WeightsError, read_arrays, sha256_of
from scripts import cli
from tests.support.errors import raises
from z1_runtime.config import load_config


def bomb() -> str:
    lines = ["a0: &a0 [l, l, l, l, l, l, l, l, l, l]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
    return "\n".join(lines)


BAD_YAML: dict[str, bytes] = {
    "latin-1": "detector: gew\u00fcrz".encode("latin-1"),
    "utf-16": "alpha: 0.5".encode("utf-16"),
    "alias bomb": bomb().encode(),
    "self reference": b"detector: &a [*a]",
    "deep": b"detector: " + b"[" * 3000 + b"]" * 3000,
    "duplicate key": b"alpha: 0.2\nalpha: 0.9",
    "duplicate inner key": b"planner:\n  lift_m: 0.1\n  lift_m: 0.2",
    "two documents": b"alpha: 0.5\n---\nalpha: 0.6",
    "tab": b"perception:\n\tvoxel_m: 0.002",
    "zero bytes": b"\0\0\0",
    "code": b"detector: !!python/object/apply:os.system ['touch PWNED']",
    "list as a key": b"? [a, b]\n: 1",
    "no date": b"detector: 2020-99-99",
    "no timestamp": b"detector: !!timestamp x",
    "no truth": b"detector: !!bool x",
    "5000 digits": b"frame_timeout_s: " + b"9" * 5000,
    "large": b"# " + b"x" * (5 << 20),
}
BAD_VALUES: dict[str, bytes] = {
    "400 digits": b"frame_timeout_s: " + b"9" * 400,
    "400 digits in a whole number": b"k_faces: " + b"9" * 400,
    "not a number": b"frame_timeout_s: .nan",
    "infinite": b"frame_timeout_s: .inf",
    "text number": b"perception: {voxel_m: 2e-3}",
    "date": b"detector: 2020-01-01",
    "set": b"executor: !!set {a, b}",
    "list": b"- alpha: 0.5",
    "true as a number": b"k_faces: true",
}


@pytest.mark.integration
@pytest.mark.parametrize("content", BAD_YAML.values(), ids=BAD_YAML.keys())
def test_content_that_is_no_plain_yaml_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "c.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        read_yaml(path, "the configuration")
    assert caught.value.code in ("not_yaml", "unreadable")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize("content", BAD_VALUES.values(), ids=BAD_VALUES.keys())
def test_a_value_that_is_no_setting_is_one_short_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "c.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


def test_a_file_may_use_anchors_and_a_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("\ufeffone: &a {x: 1}\ntwo: {<<: *a, y: 2}\nthree: *a\n")
    assert read_yaml(path, "it") == {"one": {"x": 1}, "two": {"x": 1, "y": 2}, "three": {"x": 1}}


@pytest.mark.parametrize("path", [Path("/dev/zero"), Path("/"), Path("a\0b"), Path("nowhere.yaml")])
def test_a_path_that_is_no_file_is_one_line(path: Path) -> None:
    with raises(ConfigError, "unreadable"):
        read_yaml(path, "the configuration")


def test_a_command_ends_with_exit_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("alpha: 0.2\nalpha: 0.9")
    assert cli.main(["show-config", "--config", str(path)]) == cli.BAD_USAGE
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and "line 2" in error


def header_of(shape: tuple[int, ...]) -> bytes:
    data = io.BytesIO()
    np.lib.format.write_array_header_1_0(data, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return data.getvalue()


def bad_npz(folder: Path) -> dict[str, bytes]:
    save_frames(folder / "ok.npz", make_demo_frames())
    good = (folder / "ok.npz").read_bytes()
    huge, objects = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(huge, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("colour.npy", header_of((10**15,)))
    np.savez(objects, colour=np.array([{}], dtype=object))
    return {
        "empty": b"",
        "half": good[: len(good) // 2],
        "flipped": good[:300] + bytes([good[300] ^ 255]) + good[301:],
        "pickle": pickle.dumps({}),
        "objects": objects.getvalue(),
        "huge header": huge.getvalue(),
        "text": b"not arrays",
    }


@pytest.mark.parametrize("kind", ["empty", "half", "flipped", "pickle", "objects", "huge header", "text"])
def test_a_damaged_archive_is_no_recording_and_no_weights(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "x.npz"
    path.write_bytes(bad_npz(tmp_path)[kind])
    with raises(RecordingError, "not_a_recording") as caught:
        load_frames(path)
    assert isinstance(caught.value, UsageError) and "\n" not in str(caught.value)
    path.with_suffix(".sha256").write_text(f"{sha256_of(path)}  x.npz\n")
    with raises(WeightsError, "weights_not_arrays") as caught:
        read_arrays(path, "make it")
    assert isinstance(caught.value, UsageError) and "\n" not in str(caught.value)


def test_an_archive_that_expands_beyond_the_memory_is_rejected_before_it_is_read(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("hal.base.files._MAX_ARRAYS", 1 << 20)
    np.savez_compressed(tmp_path / "zeros.npz", zeros=np.zeros(1 << 18))
    with pytest.raises(ValueError, match="expands"):
        read_npz(tmp_path / "zeros.npz")


def test_a_checksum_of_other_bytes_is_damaged_weights(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    np.savez(path, a=np.zeros(1))
    path.with_suffix(".sha256").write_bytes(b"\xff\xfe\0")
    with raises(WeightsError, "weights_damaged"):
        read_arrays(path, "make it")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe",
        b"[" * 100_000,
        b"[]",
        f'{{"format": {FORMAT!r}}}'.replace("'", '"').encode(),
        f'{{"format": "{FORMAT}", "T_mount_camera": [[{"9" * 400}]]}}'.encode(),
    ],
    ids=["empty", "not UTF-8", "deep", "a list", "no keys", "400 digits"],
)
def test_a_damaged_calibration_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "hand_eye.json"
    path.write_bytes(content)
    with raises(CalibrationFileError, "damaged_result") as caught:
        load_result(path)
    assert isinstance(caught.value, UsageError) and "\n" not in str(caught.value)
