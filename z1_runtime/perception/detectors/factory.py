"""Detectors by name; each is imported when it is made."""

from __future__ import annotations

from importlib import import_module

from hal.base.errors import InvalidValueError
from models.detector.detector import YoloConfig
from models.weights_file import WeightsError
from z1_runtime.perception.detector import Detector

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
