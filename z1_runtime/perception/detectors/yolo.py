"""Detector by YOLOv8 on the colour image, with its masks checked against the depth."""

from __future__ import annotations

import logging

import numpy as np

from hal.base.messages import RgbdFrame
from models.detector.detector import YoloConfig, YoloModel
from models.types import Detection
from z1_runtime.perception.mask_refinement import is_flat, trim_mask

_LOG = logging.getLogger(__name__)
_REPORT_CONFIDENCE = 0.1
"""Minimum confidence of a detection that an error message mentions."""


class YoloDetector:
    """YOLOv8 on the colour image; masks are trimmed by the depth, and flat detections dropped."""

    def __init__(self, config: YoloConfig | None = None) -> None:
        """Load the network; errors as in `models.detector.detector.YoloModel`."""
        self._detector = YoloModel(config)
        self.classes = self._detector.classes
        self.min_confidence = self._detector.config.min_confidence
        self.runtime = self._detector.runtime

    def detect(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> list[Detection]:
        """Return the detections that are not flat, faint ones included; see `Detector.detect`."""
        del T_base_camera
        # A configured minimum below 0.1 stays in force
        found = self._detector.detect(frame.colour, min(_REPORT_CONFIDENCE, self.min_confidence))
        return [trim_mask(d, frame.depth_m) for d in found if not self._is_flat(d, frame.depth_m)]

    def _is_flat(self, detection: Detection, depth_m: np.ndarray) -> bool:
        flat = is_flat(detection, depth_m)
        if flat and detection.confidence > self.min_confidence:
            _LOG.warning(
                "the %s (confidence %.2f) is in the plane of its surroundings, so it is rejected as a pattern; "
                "if it is "
                "an object, lower the camera, or use --detector tabletop.",
                detection.label,
                detection.confidence,
            )
        return flat
