"""Detectors: their interface and errors, and each by its name, imported when it is made."""

from __future__ import annotations

from importlib import import_module
from typing import Protocol

import numpy as np

from hal.base.errors import InvalidValueError, Z1Error
from hal.base.messages import RgbdFrame
from models.detector.detector import YoloConfig
from models.types import Detection
from models.weights_file import WeightsError


class PerceptionError(Z1Error, RuntimeError):
    """Root of all errors of perception."""

    default_code = "perception"


class NoDepthError(PerceptionError):
    """The depth image is empty."""

    default_code = "no_depth"


class NoDetectionError(PerceptionError):
    """The detector found nothing (of the wanted class)."""

    default_code = "no_detection"


class NoTableError(PerceptionError):
    """No table plane where one was expected."""

    default_code = "no_table"


class SmallCloudError(PerceptionError):
    """Too few points of the object are left after filtering."""

    default_code = "small_cloud"


class Detector(Protocol):
    """Detector of objects in a frame."""

    classes: tuple[str, ...]
    """Labels that it distinguishes; empty without classes."""
    min_confidence: float
    """Detections must be above this; `detect` may return fainter ones, for the error message."""

    def detect(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> list[Detection]:
        """Return the detections, most confident first; empty when there is none.

        Args:
            frame: the image; its depth is 0 where it shows the robot's own gripper.
            T_base_camera: (4, 4) camera pose when it was taken.

        Raises:
            PerceptionError: the frame cannot be used.
        """
        ...


def mask_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Return (u_min, v_min, u_max, v_max) of the (H, W) bool `mask`, upper ends exclusive [px]."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


_MODULE = "z1_runtime.perception.detectors"
_DETECTORS = {
    "tabletop": f"{_MODULE}.tabletop:TabletopDetector",
    "ground_truth": f"{_MODULE}.ground_truth:GroundTruthDetector",
    "yolo": f"{_MODULE}.yolo:YoloDetector",
}
DETECTORS = tuple(_DETECTORS)
"""The detectors by name."""


def make_detector(name: str, yolo: YoloConfig | None = None) -> Detector:
    """Return the detector of that name; `yolo` configures the learned one.

    Raises:
        InvalidValueError: no such name; the message lists the known ones.
        WeightsError: the weights of the learned one are missing or wrong.
    """
    if name not in _DETECTORS:
        known = ", ".join(sorted(_DETECTORS))
        raise InvalidValueError(f"there is no detector {name!r}; known: {known}.", code="unknown_detector")
    module, kind = _DETECTORS[name].split(":")
    arguments = (yolo or YoloConfig(),) if name == "yolo" else ()
    try:
        return getattr(import_module(module), kind)(*arguments)
    except WeightsError as err:
        raise WeightsError(f"{err} Without weights: --detector tabletop.", code=err.code) from err
