"""Detector that returns the simulator's ground truth."""

from __future__ import annotations

import numpy as np

from hal.base.messages import RgbdFrame
from models.types import Detection
from z1_runtime.perception.detector import PerceptionError, mask_box


class GroundTruthDetector:
    """The twin's own mask, for evaluation: it isolates the other stages from detection errors."""

    classes: tuple[str, ...] = ()
    min_confidence: float = 0.0

    def detect(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> list[Detection]:
        """Return the one object of the ground-truth mask; see `Detector.detect`."""
        if frame.ground_truth_mask is None:
            raise PerceptionError(
                "only the twin's frames carry a ground-truth mask; use --detector tabletop.", code="no_ground_truth"
            )
        if not frame.ground_truth_mask.any():
            return []
        mask = frame.ground_truth_mask
        return [Detection(label="object", confidence=1.0, box_px=mask_box(mask), mask=mask)]
