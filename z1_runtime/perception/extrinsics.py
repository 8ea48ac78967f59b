"""Extrinsics of the wrist camera: from a calibration of this very camera, or else from the mount's drawing."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hal.base import z1
from hal.base.errors import ConfigError

if TYPE_CHECKING:
    from calibration.results import CalibrationResult

FOLDER_VARIABLE = "Z1_CALIBRATIONS"
"""Environment variable with the folder of the results."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Extrinsics:
    """The hand-eye transform in force and its origin."""

    T_flange_camera: np.ndarray
    """(4, 4)."""
    origin: str
    """One line for the operator: file, date and uncertainty; or why the drawing's figures are taken."""


def results_folder(given: Path | None = None) -> Path:
    """Return the folder of results: `given`, else $Z1_CALIBRATIONS, else z1-grasp/calibrations in the user's data."""
    if given is not None:
        return given
    if named := os.environ.get(FOLDER_VARIABLE):
        return Path(named)
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "z1-grasp" / "calibrations"


def find_extrinsics(serial: str, file: Path | None = None, folder: Path | None = None) -> Extrinsics:
    """Return the extrinsics of the camera `serial`; quality warnings are logged.

    Args:
        serial: of the camera; empty without one, which then has no calibration of its own.
        file: the result to use; None takes the newest valid one of this camera, or the drawing where there is none.
        folder: folder of the results, as in `results_folder`.

    Raises:
        ConfigError: `file` is missing or damaged, of another camera, or no hand-eye result of a wrist camera.
    """
    folder = results_folder(folder)
    if file is None and not (folder.is_dir() and any(folder.iterdir())):
        return _nominal(serial, folder)
    from calibration.errors import CalibrationError  # OpenCV's calibration is needed only where there is a result
    from calibration.results import load_newest, load_result

    try:
        found = load_result(file, serial=serial) if file is not None else load_newest(folder, "hand_eye", serial)
        T_flange_camera = found.T_flange_camera
    except CalibrationError as error:
        # Only an absent result falls back to the drawing: a damaged one must not pass unnoticed
        if file is None and error.code == "missing_result":
            return _nominal(serial, folder)
        raise ConfigError(str(error), code=error.code) from error
    return Extrinsics(T_flange_camera=T_flange_camera, origin=_origin(found))


def _nominal(serial: str, folder: Path) -> Extrinsics:
    whose = f"of camera {serial}" if serial else "of this camera, which has no serial number,"
    return Extrinsics(
        T_flange_camera=z1.T_FLANGE_CAMERA,
        origin=f"the mount's drawing (no hand-eye calibration {whose} in {folder})",
    )


def _origin(found: CalibrationResult) -> str:
    errors = found.errors
    return (
        f"{found.path}, camera {found.serial}, {found.date}, "
        f"±{errors['uncertainty_mm']:.2f} mm ±{errors['uncertainty_deg']:.3f}°"
    )
