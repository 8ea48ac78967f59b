"""How the runtime is told which of several objects is the one to pick."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hal.base.errors import InvalidValueError
from hal.base.messages import RgbdFrame
from models.detector.detector import labels_for
from models.types import Detection
from sim_twin.benchmark.episodes.scenarios import Scenario
from sim_twin.model.objects import PAPER_OBJECTS
from z1_runtime.config import RuntimeConfig
from z1_runtime.perception.detectors import Detector, TabletopDetector


def select_target(config: RuntimeConfig, detector: Detector, scenario: Scenario) -> tuple[RuntimeConfig, Detector]:
    """Return the configuration and the detector with which `scenario` is seen.

    A detector that knows the object's class is told it as a user would; one that knows none takes, among neighbours,
    what covers most of the truth. An object of no class that the detector knows is seen as `object_class` if the user
    chose one, else by `TabletopDetector`.

    Raises:
        ValueError: the detector knows classes, and none for one of the paper's objects.
    """
    if detector.classes and (scenario.object in PAPER_OBJECTS or scenario.object in detector.classes):
        labels_for(scenario.object, detector.classes)  # better refused now than in every episode
        return replace(config, object_class=scenario.object), detector
    if detector.classes and not config.object_class:
        detector = TabletopDetector()
    return config, TargetDetector(detector) if scenario.clutter else detector


class TargetDetector:
    """Of what another detector finds, what covers most of the object that the twin says is meant."""

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self.classes, self.min_confidence = detector.classes, detector.min_confidence

    def detect(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> list[Detection]:
        """Return that one, or nothing if none touches it; see `z1_runtime.perception.detectors.Detector.detect`."""
        if frame.ground_truth_mask is None:
            raise InvalidValueError("only the twin's frames say which object is meant.")
        found = self._detector.detect(frame, T_base_camera)
        overlaps = [compute_iou(detection, frame.ground_truth_mask) for detection in found]
        best = int(np.argmax(overlaps)) if found else -1
        return [found[best]] if found and overlaps[best] > 0.0 else []


def compute_iou(detection: Detection, truth: np.ndarray) -> float:
    """Return how well a detection, by its mask or else its box, meets the `truth` (H, W): area shared over area of
    either."""
    mask = detection.mask
    if mask is None:
        mask = np.zeros_like(truth)
        left, top, right, bottom = (round(float(edge)) for edge in detection.box_px)
        mask[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = True
    return float((mask & truth).sum() / max((mask | truth).sum(), 1))
