"""Results on disk: versioned, with their origin, never overwritten and never half-written.

`hand_eye_<serial>_v0001.json`, `intrinsics_<serial>_v0001.json`, … The newest is the one with the highest number.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from calibration.board import Board
from calibration.camera_model import CameraModel
from calibration.errors import CalibrationWarning
from calibration.hand_eye_result import HandEyeResult, Setup
from calibration.intrinsics import IntrinsicsResult

Kind = Literal["hand_eye", "intrinsics"]

MAX_UNCERTAINTY_MM = 1.0
"""A hand-eye result less certain than this is used with a warning."""
MAX_UNCERTAINTY_DEG = 0.2
"""The same for its orientation."""
MAX_RMS_PX = 0.5
"""Intrinsics with a greater reprojection error are used with a warning."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """One result with its origin."""

    kind: Kind
    """What was calibrated."""
    serial: str
    """The camera's serial number."""
    date: str
    """When, ISO 8601, from the caller."""
    board: Board
    """With which board."""
    camera: CameraModel
    """The camera found (intrinsics) or used (hand-eye)."""
    samples: dict[str, Any]
    """`folder`, `used` (names), `dropped` (name: reason)."""
    errors: dict[str, float]
    """hand_eye: `uncertainty_mm`, `uncertainty_deg`, `rms_mm`, `rms_deg`, `holdout_mm`, `holdout_deg`, `diversity`,
    and with refinement `rms_px`. intrinsics: `rms_px`, `holdout_px`."""
    warnings: tuple[CalibrationWarning, ...] = ()
    """What the solver warned of."""
    setup: Setup | None = None
    """Of a hand-eye result."""
    T_mount_camera: np.ndarray | None = None
    """(4, 4) of a hand-eye result: the camera on the flange (eye in hand) or in the base (eye to hand)."""
    T_anchor_board: np.ndarray | None = None
    """(4, 4) of a hand-eye result."""
    covariance: np.ndarray | None = None
    """(6, 6) of a hand-eye result, as `HandEyeResult.covariance`."""
    path: Path | None = None
    """The file it was read from."""

    @property
    def T_flange_camera(self) -> np.ndarray:
        """(4, 4) the camera on the flange.

        Raises:
            CalibrationError: not a hand-eye result, or one of an eye to hand.
        """
        raise NotImplementedError

    @classmethod
    def of_hand_eye(
        cls, result: HandEyeResult, *, serial: str, date: str, board: Board, camera: CameraModel, folder: str
    ) -> Calibration:
        """Return `result` with its origin; `folder` is where its samples are."""
        raise NotImplementedError

    @classmethod
    def of_intrinsics(
        cls, result: IntrinsicsResult, *, serial: str, date: str, board: Board, folder: str
    ) -> Calibration:
        """Return `result` with its origin; `folder` is where its samples are."""
        raise NotImplementedError


def save_result(folder: Path, calibration: Calibration) -> Path:
    """Write the next version into `folder` and return its path; no file that exists is ever touched."""
    raise NotImplementedError


def load_result(path: Path, *, serial: str | None = None) -> Calibration:
    """Return the result in `path`, and log which it is and whatever is doubtful about it.

    Raises:
        CalibrationError: `damaged_result`, `missing_result`, or `wrong_serial` (it is of another camera than `serial`).
    """
    raise NotImplementedError


def load_newest(folder: Path, kind: Kind, serial: str) -> Calibration:
    """Return the newest valid result of this camera; damaged ones are skipped with a message.

    Raises:
        CalibrationError: `missing_result` (none of this camera; those of others are listed).
    """
    raise NotImplementedError
