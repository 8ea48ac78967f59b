"""Samples on disk as they are taken, so that a session can be solved again, and a crash loses nothing.

A folder holds `session.json` and, for each sample, `0001.png` (lossless) and `0001.json`; the JSON is written last and
tells the picture's checksum, so a sample is whole when its JSON is.
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
from calibration.errors import CalibrationError, CalibrationWarning
from calibration.files import write_new
from calibration.hand_eye.result import Setup
from calibration.transforms import check_poses
from hal.base.errors import InvalidValueError

FORMAT = 1
"""Of the files; one that a newer version wrote is refused rather than guessed at."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Session:
    """What all samples of a folder have in common."""

    board: Board
    """The board seen."""
    serial: str
    """The camera's serial number."""
    setup: Setup
    """Whether the arm carries the camera or the board."""
    camera: CameraModel
    """The camera as the device describes itself."""
    date: str
    """When the session began, ISO 8601, from the caller."""
    truth: dict[str, Any] | None = None
    """What only a twin knows, for evaluation: `T_mount_camera`, `T_anchor_board` as nested lists."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """One picture of the board and where the arm stood."""

    image: np.ndarray
    """(H, W, 3) RGB or (H, W) grey, uint8."""
    T_base_flange: np.ndarray
    """(4, 4) the arm's pose by its own kinematics."""
    q: np.ndarray
    """(7,) measured joint positions [rad]."""
    stamp_s: float
    """Mid-exposure time [s]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoadedSamples:
    """What a folder holds."""

    session: Session
    """Of the folder."""
    names: tuple[str, ...]
    """(N,) "0001", "0002", …"""
    samples: tuple[Sample, ...]
    """(N,) the samples that can be read, in the order they were taken."""
    warnings: tuple[CalibrationWarning, ...]
    """`damaged_sample` for each one that cannot; its files are left as they are."""


def open_session(folder: Path, session: Session) -> None:
    """Make `folder`, or go on in it when it holds a session of the same board, camera and setup.

    Raises:
        CalibrationError: it holds another session.
    """
    folder.mkdir(parents=True, exist_ok=True)
    values = {
        "format": FORMAT,
        "board": session.board.to_dict(),
        "serial": session.serial,
        "setup": session.setup,
        "camera": session.camera.to_dict(),
        "date": session.date,
        "truth": session.truth,
    }
    if write_new(folder / "session.json", _json(values)):
        return
    there = load_session(folder)
    ours = (session.board, session.serial, session.setup, session.camera.to_dict())
    if (there.board, there.serial, there.setup, there.camera.to_dict()) != ours:
        raise CalibrationError(
            "other_session",
            f"{folder} holds a session of camera {there.serial}, {there.setup}, {there.board}, begun {there.date}; "
            "give another folder.",
        )


def load_session(folder: Path) -> Session:
    """Return what all samples of `folder` have in common.

    Raises:
        CalibrationError: `no_session`.
    """
    path = folder / "session.json"
    try:
        values = json.loads(path.read_text())
        if values["format"] != FORMAT:
            raise InvalidValueError(f"its format is {values['format']!r}, known is {FORMAT}")
        return Session(
            board=Board.from_dict(values["board"]),
            serial=str(values["serial"]),
            setup=values["setup"],
            camera=CameraModel.from_dict(values["camera"]),
            date=str(values["date"]),
            truth=values["truth"],
        )
    except FileNotFoundError as error:
        raise CalibrationError("no_session", f"{folder} holds no calibration session (no session.json).") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CalibrationError("no_session", f"{path} cannot be read: {error!r}.") from error


def save_sample(folder: Path, sample: Sample) -> str:
    """Keep `sample` under the next free number and return its name; whole or not at all.

    Raises:
        CalibrationError: no session in `folder`, or a sample that is not one (shapes, values).
    """
    session = load_session(folder)
    _check_sample(sample, session)
    picture = io.BytesIO()
    Image.fromarray(sample.image).save(picture, format="PNG", compress_level=1)  # 7 times as fast as 6, 17 % larger
    number = 1 + max((int(path.stem) for path in folder.iterdir() if path.stem.isdigit()), default=0)
    while not write_new(folder / f"{number:04d}.png", picture.getvalue()):
        number += 1  # another process took this number
    values = {
        "format": FORMAT,
        "image_sha256": hashlib.sha256(picture.getvalue()).hexdigest(),
        "T_base_flange": sample.T_base_flange.tolist(),
        "q": sample.q.tolist(),
        "stamp_s": float(sample.stamp_s),
    }
    write_new(folder / f"{number:04d}.json", _json(values))
    return f"{number:04d}"


def load_samples(folder: Path) -> LoadedSamples:
    """Return all samples that can be read; the others are told in the warnings.

    Raises:
        CalibrationError: no session, or one that cannot be read.
    """
    session = load_session(folder)
    names, samples, warnings = [], [], []
    for name in sorted({path.stem for path in folder.iterdir() if path.stem.isdigit()}, key=int):
        try:
            samples.append(_load_sample(folder, name, session))
            names.append(name)
        except (OSError, ValueError, KeyError, TypeError, SyntaxError) as error:  # Pillow: SyntaxError for a broken PNG
            message = f"sample {name} of {folder} cannot be used and was left out: {error}"
            warnings.append(CalibrationWarning(code="damaged_sample", message=message, samples=(name,)))
    return LoadedSamples(session=session, names=tuple(names), samples=tuple(samples), warnings=tuple(warnings))


def _load_sample(folder: Path, name: str, session: Session) -> Sample:
    values = json.loads((folder / f"{name}.json").read_text())
    if values["format"] != FORMAT:
        raise InvalidValueError(f"its format is {values['format']!r}, known is {FORMAT}.")
    picture = (folder / f"{name}.png").read_bytes()
    if hashlib.sha256(picture).hexdigest() != values["image_sha256"]:
        raise InvalidValueError("its picture is not the one that was taken (checksum).")
    with Image.open(io.BytesIO(picture)) as image:
        pixels = np.asarray(image)
    sample = Sample(
        image=pixels,
        T_base_flange=np.array(values["T_base_flange"], dtype=np.float64),
        q=np.array(values["q"], dtype=np.float64),
        stamp_s=float(values["stamp_s"]),
    )
    _check_sample(sample, session)
    return sample


def _check_sample(sample: Sample, session: Session) -> None:
    width, height = session.camera.size
    if sample.image.dtype != np.uint8 or sample.image.shape not in ((height, width, 3), (height, width)):
        raise CalibrationError(
            "bad_sample",
            f"an image of {sample.image.shape} {sample.image.dtype} is not of this session's camera: "
            f"({height}, {width}, 3) or ({height}, {width}) of uint8.",
        )
    check_poses(np.asarray(sample.T_base_flange)[None], "T_base_flange")
    if sample.q.ndim != 1 or not np.isfinite(sample.q).all() or not np.isfinite(sample.stamp_s):
        raise CalibrationError("bad_sample", f"joints {sample.q} or stamp {sample.stamp_s} are not finite numbers.")


def _json(values: dict[str, Any]) -> bytes:
    return (json.dumps(values, indent=2, allow_nan=False) + "\n").encode()
