"""Detectors by name; each is imported when it is made."""

from __future__ import annotations

from collections.abc import Callable

from hal.base.errors import InvalidValueError
from models.detector.detector import YoloConfig
from models.weights_file import WeightsError
from z1_runtime.perception.detector import Detector
from z1_runtime.perception.detectors.ground_truth import GroundTruthDetector
from z1_runtime.perception.detectors.tabletop import TabletopDetector
from z1_runtime.perception.detectors.yolo import YoloDetector

_DETECTORS: dict[str, Callable[[YoloConfig], Detector]] = {
    "tabletop": lambda _: TabletopDetector(),
    "ground_truth": lambda _: GroundTruthDetector(),
    "yolo": YoloDetector,
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
    try:
        return _DETECTORS[name](yolo or YoloConfig())
    except WeightsError as err:
        raise WeightsError(f"{err} Without weights: --detector tabletop.", code=err.code) from err
