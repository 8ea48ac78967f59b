"""Samples on disk as they are taken, so that a session can be solved again, and a crash loses nothing.

A folder holds `session.json` and, for each sample, `0001.png` (lossless) and `0001.json`; the JSON is written last and
tells the picture's checksum, so a sample is whole when its JSON is.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.board import Board
from calibration.camera_model import CameraModel
from calibration.errors import CalibrationWarning
from calibration.hand_eye_result import Setup


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
    raise NotImplementedError


def save_sample(folder: Path, sample: Sample) -> str:
    """Keep `sample` under the next free number and return its name; whole or not at all.

    Raises:
        CalibrationError: no session in `folder`, or a sample that is not one (shapes, values).
    """
    raise NotImplementedError


def load_samples(folder: Path) -> LoadedSamples:
    """Return all samples that can be read; the others are told in the warnings.

    Raises:
        CalibrationError: no session, or one that cannot be read.
    """
    raise NotImplementedError
