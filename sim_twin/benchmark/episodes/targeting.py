"""Selection of the object to pick among several, for the runtime's detector."""

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
from z1_runtime.perception.detector import Detector
from z1_runtime.perception.detectors.tabletop import TabletopDetector


def select_target(config: RuntimeConfig, detector: Detector, scenario: Scenario) -> tuple[RuntimeConfig, Detector]:
    """Return the configuration and the detector for `scenario`.

    A detector that knows the object's class gets it as from a user; of one that knows none the detection with the
    greatest overlap with the ground truth is used among neighbours. An object of unknown class is detected as
    `object_class` if the user chose one, else by `TabletopDetector`.

    Raises:
        ValueError: the detector knows classes, and none for one of the paper's objects.
    """
    if detector.classes and (scenario.object in PAPER_OBJECTS or scenario.object in detector.classes):
        labels_for(scenario.object, detector.classes)  # a clear error now instead of one in every episode
        return replace(config, object_class=scenario.object), detector
    if detector.classes and not config.object_class:
        detector = TabletopDetector()
    return config, TargetDetector(detector) if scenario.clutter else detector


class TargetDetector:
    """Detector that keeps of another's detections the one with the greatest overlap with the ground truth."""

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self.classes, self.min_confidence = detector.classes, detector.min_confidence

    def detect(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> list[Detection]:
        """Return that detection, or none without overlap; see `z1_runtime.perception.detectors.Detector.detect`."""
        if frame.ground_truth_mask is None:
            raise InvalidValueError(
                "target: the frame has no ground-truth mask. Use frames of the twin.", code="no_ground_truth"
            )
        found = self._detector.detect(frame, T_base_camera)
        overlaps = [compute_iou(detection, frame.ground_truth_mask) for detection in found]
        best = int(np.argmax(overlaps)) if found else -1
        return [found[best]] if found and overlaps[best] > 0.0 else []


def compute_iou(detection: Detection, ground_truth: np.ndarray) -> float:
    """Return the intersection over union of a detection's mask, or else its box, with `ground_truth` (H, W)."""
    mask = detection.mask
    if mask is None:
        mask = np.zeros_like(ground_truth)
        left, top, right, bottom = (round(float(edge)) for edge in detection.box_px)
        mask[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = True
    return float((mask & ground_truth).sum() / max((mask | ground_truth).sum(), 1))
