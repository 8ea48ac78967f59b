"""Samples on disk, written at capture, so that they can be solved again and a crash loses none.

A folder holds `session.json` and, for each sample, `0001.png` (lossless) and `0001.json`; the JSON is written last and
holds the image's checksum, so a sample is complete when its JSON is.
"""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from calibration.board.board import Board
from calibration.camera_model import CameraModel
from calibration.errors import CalibrationError, CalibrationFileError, CalibrationWarning
from calibration.files import write_new
from calibration.hand_eye.result import Setup
from calibration.pose_checks import check_poses
from hal.base.errors import InvalidValueError
from hal.base.files import read_text

FORMAT = 1
"""Version of the file format; another one is rejected."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CaptureInfo:
    """Common properties of all samples in a folder, stored as `session.json`."""

    board: Board
    """The board."""
    serial: str
    """The camera's serial number."""
    setup: Setup
    """Whether the arm carries the camera or the board."""
    camera: CameraModel
    """The camera by the device's own intrinsics."""
    date: str
    """Start of the capture, ISO 8601, from the caller."""
    ground_truth: dict[str, Any] | None = None
    """Of a twin, for evaluation: `T_mount_camera`, `T_anchor_board` as nested lists."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """One image of the board with the arm's pose."""

    image: np.ndarray
    """(H, W, 3) RGB or (H, W) grey, uint8."""
    T_base_flange: np.ndarray
    """(4, 4) the arm's pose by its kinematics."""
    q: np.ndarray
    """(7,) measured joint positions [rad]."""
    stamp_s: float
    """Mid-exposure time [s]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoadedSamples:
    """The samples of a folder."""

    info: CaptureInfo
    """Common properties."""
    names: tuple[str, ...]
    """(N,) "0001", "0002", …"""
    samples: tuple[Sample, ...]
    """(N,) the valid samples in the order of their capture."""
    warnings: tuple[CalibrationWarning, ...]
    """`damaged_sample` for each invalid one; its files are left unchanged."""


def open_sample_folder(folder: Path, info: CaptureInfo) -> None:
    """Create `folder`, or continue in it when it holds samples of the same board, camera and setup.

    Raises:
        CalibrationError: `other_session`: its board, camera or setup differ.
    """
    folder.mkdir(parents=True, exist_ok=True)
    values = {
        "format": FORMAT,
        "board": info.board.to_dict(),
        "serial": info.serial,
        "setup": info.setup,
        "camera": info.camera.to_dict(),
        "date": info.date,
        "truth": info.ground_truth,
    }
    if write_new(folder / "session.json", _json(values)):
        return
    existing = load_capture_info(folder)
    wanted = (info.board, info.serial, info.setup, info.camera.to_dict())
    if (existing.board, existing.serial, existing.setup, existing.camera.to_dict()) != wanted:
        raise CalibrationFileError(
            f"samples: {folder} holds others (camera {existing.serial}, {existing.setup}, {existing.board}, started "
            f"{existing.date}). Give another folder.",
            code="other_session",
        )


def load_capture_info(folder: Path) -> CaptureInfo:
    """Return the common properties of the samples in `folder`.

    Raises:
        CalibrationError: `no_session`: missing or damaged.
    """
    path = folder / "session.json"
    try:
        values = json.loads(read_text(path))
        if values["format"] != FORMAT:
            raise InvalidValueError(f"unknown format ({values['format']!r}, known: {FORMAT})")
        return CaptureInfo(
            board=Board.from_dict(values["board"]),
            serial=str(values["serial"]),
            setup=values["setup"],
            camera=CameraModel.from_dict(values["camera"]),
            date=str(values["date"]),
            ground_truth=values["truth"],
        )
    except FileNotFoundError as error:
        raise CalibrationFileError(
            f"samples: {folder} has no session.json. Capture samples there with `./z1 calibrate capture`.",
            code="no_session",
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise CalibrationFileError(
            f"samples: {path} cannot be read ({error!r}). Capture again into another folder.", code="no_session"
        ) from error


def save_sample(folder: Path, sample: Sample) -> str:
    """Save `sample` atomically under the next free number and return its name.

    Raises:
        CalibrationError: `no_session`, or `bad_sample`, `bad_poses` (shapes, values).
    """
    info = load_capture_info(folder)
    _check_sample(sample, info)
    png = io.BytesIO()
    Image.fromarray(sample.image).save(png, format="PNG", compress_level=1)  # 7 times as fast as level 6, 17 % larger
    number = 1 + max((int(path.stem) for path in folder.iterdir() if path.stem.isdigit()), default=0)
    while not write_new(folder / f"{number:04d}.png", png.getvalue()):
        number += 1  # another process took this number
    values = {
        "format": FORMAT,
        "image_sha256": hashlib.sha256(png.getvalue()).hexdigest(),
        "T_base_flange": sample.T_base_flange.tolist(),
        "q": sample.q.tolist(),
        "stamp_s": float(sample.stamp_s),
    }
    write_new(folder / f"{number:04d}.json", _json(values))
    return f"{number:04d}"


def load_samples(folder: Path) -> LoadedSamples:
    """Return all valid samples, with a warning for each of the others.

    Raises:
        CalibrationError: `no_session`.
    """
    info = load_capture_info(folder)
    names, samples, warnings = [], [], []
    for name in sorted({path.stem for path in folder.iterdir() if path.stem.isdigit()}, key=int):
        try:
            samples.append(_load_sample(folder, name, info))
            names.append(name)
        except (OSError, ValueError, KeyError, TypeError, SyntaxError) as error:  # Pillow: SyntaxError for a broken PNG
            message = f"sample {name} of {folder} is invalid and was left out: {error}"
            warnings.append(CalibrationWarning(code="damaged_sample", message=message, samples=(name,)))
    return LoadedSamples(info=info, names=tuple(names), samples=tuple(samples), warnings=tuple(warnings))


def _load_sample(folder: Path, name: str, info: CaptureInfo) -> Sample:
    values = json.loads((folder / f"{name}.json").read_text())
    if values["format"] != FORMAT:
        raise InvalidValueError(f"unknown format ({values['format']!r}, known: {FORMAT}).")
    png = (folder / f"{name}.png").read_bytes()
    if hashlib.sha256(png).hexdigest() != values["image_sha256"]:
        raise InvalidValueError("the image does not match its checksum.")
    with Image.open(io.BytesIO(png)) as image:
        pixels = np.asarray(image)
    sample = Sample(
        image=pixels,
        T_base_flange=np.array(values["T_base_flange"], dtype=np.float64),
        q=np.array(values["q"], dtype=np.float64),
        stamp_s=float(values["stamp_s"]),
    )
    _check_sample(sample, info)
    return sample


def _check_sample(sample: Sample, info: CaptureInfo) -> None:
    width, height = info.camera.size
    if sample.image.dtype != np.uint8 or sample.image.shape not in ((height, width, 3), (height, width)):
        raise CalibrationError(
            f"sample: wrong image ({sample.image.shape} {sample.image.dtype}, allowed ({height}, {width}, 3) or "
            f"({height}, {width}) uint8).",
            code="bad_sample",
        )
    check_poses(np.asarray(sample.T_base_flange)[None], "T_base_flange")
    if sample.q.ndim != 1 or not np.isfinite(sample.q).all() or not np.isfinite(sample.stamp_s):
        raise CalibrationError(
            f"sample: joints {sample.q} or stamp {sample.stamp_s} are not finite.", code="bad_sample"
        )


def _json(values: dict[str, Any]) -> bytes:
    return (json.dumps(values, indent=2, allow_nan=False) + "\n").encode()
