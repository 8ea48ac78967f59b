"""Calibration results on disk: versioned, with their origin, written atomically and never overwritten.

`hand_eye_<serial>_v0001.json`, `intrinsics_<serial>_v0001.json`, … The newest is the one with the highest number.
"""

from __future__ import annotations

import json
import logging
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from calibration.board.board import Board
from calibration.camera_model import CameraModel
from calibration.errors import CalibrationError, CalibrationFileError, CalibrationWarning
from calibration.files import write_new
from calibration.hand_eye.result import HandEyeResult, Setup
from calibration.intrinsics import IntrinsicsResult
from calibration.pose_checks import check_poses
from hal.base.errors import InvalidValueError
from hal.base.files import read_text

logger = logging.getLogger(__name__)

Kind = Literal["hand_eye", "intrinsics"]

FORMAT = 1
"""Version of the file format; another one is rejected."""
MAX_UNCERTAINTY_MM = 1.0
"""A hand-eye result with a larger uncertainty is used with a warning."""
MAX_UNCERTAINTY_DEG = 0.2
"""The same for its orientation."""
MAX_RMS_PX = 0.5
"""Intrinsics with a larger reprojection error are used with a warning."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationResult:
    """One result with its origin."""

    kind: Kind
    """The calibrated quantity."""
    serial: str
    """The camera's serial number."""
    date: str
    """ISO 8601, from the caller."""
    board: Board
    """The board used."""
    camera: CameraModel
    """The estimated camera (intrinsics) or the assumed one (hand-eye)."""
    samples: dict[str, Any]
    """`folder`, `used` (names), `dropped` (name: reason)."""
    errors: dict[str, float]
    """hand_eye: `uncertainty_mm`, `uncertainty_deg`, `rms_mm`, `rms_deg`, `holdout_mm`, `holdout_deg`, `diversity`,
    and with refinement `rms_px`. intrinsics: `rms_px`, `holdout_px`."""
    warnings: tuple[CalibrationWarning, ...] = ()
    """The solver's warnings."""
    setup: Setup | None = None
    """Of a hand-eye result."""
    T_mount_camera: np.ndarray | None = None
    """(4, 4) of a hand-eye result: the camera on the flange (eye in hand) or in the base (eye to hand)."""
    T_anchor_board: np.ndarray | None = None
    """(4, 4) of a hand-eye result."""
    covariance: np.ndarray | None = None
    """(6, 6) of a hand-eye result, as `HandEyeResult.covariance`."""
    path: Path | None = None
    """The file of the result."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind) or not self.serial or not self.date:
            raise CalibrationError(
                f"invalid result: kind, serial and date are required ({self.kind!r}, {self.serial!r}, {self.date!r}).",
                code="bad_result",
            )
        if self.kind == "hand_eye":
            if self.setup not in get_args(Setup) or self.T_mount_camera is None or self.T_anchor_board is None:
                raise CalibrationError(
                    f"invalid hand-eye result: setup ({self.setup!r}) and poses are required.", code="bad_result"
                )
            check_poses(np.array([self.T_mount_camera, self.T_anchor_board]), "T_mount_camera, T_anchor_board")
        numbers = [*self.errors.values(), *([] if self.covariance is None else np.ravel(self.covariance))]
        if not np.isfinite(np.array(numbers, dtype=np.float64)).all():
            raise CalibrationError(
                f"invalid result: errors {self.errors} or covariance are not finite.", code="bad_result"
            )

    @property
    def T_flange_camera(self) -> np.ndarray:
        """(4, 4) the camera on the flange.

        Raises:
            CalibrationError: `wrong_setup`: not a hand-eye result, or an eye-to-hand one.
        """
        return self._pose_of("eye_in_hand")

    @property
    def T_base_camera(self) -> np.ndarray:
        """(4, 4) the camera in the base.

        Raises:
            CalibrationError: `wrong_setup`: not a hand-eye result, or an eye-in-hand one.
        """
        return self._pose_of("eye_to_hand")

    def _pose_of(self, setup: Setup) -> np.ndarray:
        if self.setup != setup or self.T_mount_camera is None:
            raise CalibrationError(
                f"{self}: wrong setup ({self.setup or self.kind}, needed {setup}).", code="wrong_setup"
            )
        return self.T_mount_camera

    def __str__(self) -> str:
        figures = ", ".join(f"{name} {value:.3g}" for name, value in self.errors.items())
        place = "" if self.path is None else f" in {self.path}"
        return f"{self.kind} of camera {self.serial}, {self.date}{place} ({figures})"

    def quality_warnings(self) -> list[str]:
        """Return messages about figures above the thresholds, and the solver's warnings."""
        limits = {"uncertainty_mm": MAX_UNCERTAINTY_MM, "uncertainty_deg": MAX_UNCERTAINTY_DEG}
        if self.kind == "intrinsics":
            limits = {"rms_px": MAX_RMS_PX}
        above = [
            f"{name} is {self.errors[name]:.3g}, up to {limit:g} is good; calibrate again"
            for name, limit in limits.items()
            if self.errors.get(name, 0.0) > limit
        ]
        return above + [warning.message for warning in self.warnings]

    @classmethod
    def of_hand_eye(
        cls, result: HandEyeResult, *, serial: str, date: str, board: Board, camera: CameraModel, folder: str
    ) -> CalibrationResult:
        """Return `result` with its origin; `folder` holds its samples."""
        names = ("uncertainty_mm", "uncertainty_deg", "rms_mm", "rms_deg", "holdout_mm", "holdout_deg", "diversity")
        errors = {name: float(getattr(result, name)) for name in names}
        if result.rms_px is not None:
            errors["rms_px"] = result.rms_px
        return cls(
            kind="hand_eye",
            serial=serial,
            date=date,
            board=board,
            camera=camera,
            samples=_origin(folder, result.sample_names, result.dropped),
            errors=errors,
            warnings=result.warnings,
            setup=result.setup,
            T_mount_camera=result.T_mount_camera,
            T_anchor_board=result.T_anchor_board,
            covariance=result.covariance,
        )

    @classmethod
    def of_intrinsics(
        cls, result: IntrinsicsResult, *, serial: str, date: str, board: Board, folder: str
    ) -> CalibrationResult:
        """Return `result` with its origin; `folder` holds its samples."""
        return cls(
            kind="intrinsics",
            serial=serial,
            date=date,
            board=board,
            camera=result.camera,
            samples=_origin(folder, result.view_names, result.rejected),
            errors={"rms_px": result.rms_px, "holdout_px": result.holdout_px},
            warnings=result.warnings,
        )


def _origin(folder: str, names: tuple[str, ...], dropped: dict[str, str]) -> dict[str, Any]:
    return {"folder": folder, "used": [name for name in names if name not in dropped], "dropped": dict(dropped)}


def save_result(folder: Path, calibration: CalibrationResult) -> Path:
    """Write the next version into `folder` and return its path; no file that exists is ever touched."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays = ("T_mount_camera", "T_anchor_board", "covariance")
    values = {
        "format": FORMAT,
        "kind": calibration.kind,
        "serial": calibration.serial,
        "date": calibration.date,
        "board": calibration.board.to_dict(),
        "camera": calibration.camera.to_dict(),
        "samples": calibration.samples,
        "errors": calibration.errors,
        "warnings": [asdict(warning) for warning in calibration.warnings],
        "setup": calibration.setup,
    } | {name: None if (a := getattr(calibration, name)) is None else np.asarray(a).tolist() for name in arrays}
    content = (json.dumps(values, indent=2, allow_nan=False) + "\n").encode()
    stem = _stem(calibration.kind, calibration.serial)
    version = 1 + max((_version(path, stem) for path in folder.iterdir()), default=0)
    while not write_new(folder / f"{stem}_v{version:04d}.json", content):
        version += 1  # another process took this number
    return folder / f"{stem}_v{version:04d}.json"


def _stem(kind: str, serial: str) -> str:
    return f"{kind}_{re.sub(r'[^A-Za-z0-9.-]', '-', serial)}"


def _version(path: Path, stem: str) -> int:
    """Return the version in a file's name; 0 for another kind of file."""
    match = re.fullmatch(re.escape(stem) + r"_v(\d+)\.json", path.name)
    return int(match[1]) if match else 0


def load_result(path: Path, *, serial: str | None = None) -> CalibrationResult:
    """Return the result in `path`, and log its summary and its quality warnings.

    Raises:
        CalibrationError: `damaged_result`, `missing_result`, or `wrong_serial` (of another camera than `serial`).
    """
    found = _read(path)
    if serial is not None and found.serial != serial:
        raise CalibrationFileError(
            f"{path}: result of camera {found.serial}, the connected camera is {serial}. Calibrate it, or give "
            "its own file.",
            code="wrong_serial",
        )
    logger.info("calibration: %s", found)
    for message in found.quality_warnings():
        logger.warning("calibration %s: %s", path.name, message)
    return found


def _read(path: Path) -> CalibrationResult:
    try:
        values = json.loads(read_text(path))
        if values["format"] != FORMAT:
            raise InvalidValueError(f"unknown format ({values['format']!r}, known: {FORMAT})")
        arrays = {
            name: None if values[name] is None else np.array(values[name], dtype=np.float64)
            for name in ("T_mount_camera", "T_anchor_board", "covariance")
        }
        return CalibrationResult(
            kind=values["kind"],
            serial=values["serial"],
            date=values["date"],
            board=Board.from_dict(values["board"]),
            camera=CameraModel.from_dict(values["camera"]),
            samples=values["samples"],
            errors={name: float(value) for name, value in values["errors"].items()},
            warnings=tuple(
                CalibrationWarning(code=w["code"], message=w["message"], samples=tuple(w["samples"]))
                for w in values["warnings"]
            ),
            setup=values["setup"],
            path=path,
            **arrays,
        )
    except FileNotFoundError as error:
        raise CalibrationFileError(
            f"there is no calibration result {path}. Run `./z1 calibrate`, or give another file.", code="missing_result"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise CalibrationFileError(
            f"{path}: this is no calibration result ({error!r}). Calibrate again, or give another file.",
            code="damaged_result",
        ) from error


def load_newest(folder: Path, kind: Kind, serial: str) -> CalibrationResult:
    """Return the newest valid result of this camera; damaged ones are skipped with a message.

    Raises:
        CalibrationError: `missing_result` (none of this camera; the message lists the others).
    """
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    stem = _stem(kind, serial)
    for path in sorted((p for p in files if _version(p, stem)), key=lambda p: -_version(p, stem)):
        try:
            return load_result(path, serial=serial)
        except CalibrationError as error:
            logger.warning("calibration skipped: %s", error)
    others = ", ".join(p.name for p in files if p.suffix == ".json") or "nothing"
    raise CalibrationFileError(
        f"{folder}: no valid {kind} calibration of camera {serial} (found: {others}). Run `./z1 calibrate`.",
        code="missing_result",
    )
