"""Detector by YOLOv8 on the colour image; the depth shows where its masks end, and what is no object at all."""

from __future__ import annotations

import logging
from dataclasses import replace

import cv2
import numpy as np

from hal.base.messages import RgbdFrame
from models.detector.detector import YoloConfig, YoloModel
from models.types import Detection
from z1_runtime.perception.point_cloud import box_pixels

_EDGE_PX = 4
"""Masks are a few pixels off at their edge, where the background begins."""
_EDGE_M = 0.010
"""Maximum depth difference of an edge pixel from all inner ones [m]."""
_GAP_PX, _GAP_RATIO = 6, 0.1
"""Distance of the surroundings from the mask, and its ratio of the mask's size: nearer pixels may be a part of a box's
face that the mask missed."""
_RING_PX = 12
"""Width of the surroundings."""
_FLAT_M, _FLAT_PER_M = 0.005, 0.020
"""Maximum distance of a printed pattern from the plane around it; `_FLAT_PER_M` z² is added for the noise [m, 1/m]."""
_RING_RATIO, _INSIDE_RATIO = 0.5, 0.85
"""Minimum ratios of the surroundings and of the detection in one plane: much of a bounding box is background."""
_MIN_PX = 60


def trim_mask(detection: Detection, depth_m: np.ndarray) -> Detection:
    """Return `detection` without the pixels at its mask's edge that were measured in front of or behind the object.

    Pixels without depth stay, as in the masks of the tabletop detector: holes belong to their surroundings.

    Args:
        detection: one without a mask stays as it is.
        depth_m: (H, W), 0 where nothing was measured [m].
    """
    mask = detection.mask
    if mask is None:
        return detection
    inner = _grow(mask, -_EDGE_PX)
    depths = depth_m[inner & (depth_m > 0)]
    if not len(depths):
        return detection  # too thin to have an inside
    nearest, farthest = np.percentile(depths, [1.0, 99.0])
    outside = (depth_m > 0) & ((depth_m < nearest - _EDGE_M) | (depth_m > farthest + _EDGE_M))
    return replace(detection, mask=mask & (inner | ~outside))


def is_flat(detection: Detection, depth_m: np.ndarray) -> bool:
    """Return whether a detection is in the plane of its surroundings: a pattern or a shadow, not an object.

    False where depth cannot decide: too little of it was measured, or the surroundings are no plane.

    Args:
        detection: with a mask; without one its box is taken.
        depth_m: (H, W), 0 where nothing was measured [m].
    """
    mask = detection.mask if detection.mask is not None else box_pixels(depth_m.shape, detection.box_px)
    measured = depth_m > 0
    u_min, v_min, u_max, v_max = detection.box_px
    gap = round(_GAP_PX + _GAP_RATIO * max(u_max - u_min, v_max - v_min))
    ring, inside = _grow(mask, gap + _RING_PX) & ~_grow(mask, gap) & measured, mask & measured
    if min(ring.sum(), inside.sum()) < _MIN_PX:
        return False
    # The inverse depth of a plane is affine in the pixel coordinates
    v, u = np.nonzero(ring)
    plane, *_ = np.linalg.lstsq(np.column_stack([u, v, np.ones(len(u))]), 1.0 / depth_m[ring], rcond=None)
    ratios = ((ring, _RING_RATIO), (inside, _INSIDE_RATIO))
    return all(_ratio_in_plane(plane, pixels, depth_m) > minimum for pixels, minimum in ratios)


def _ratio_in_plane(plane: np.ndarray, pixels: np.ndarray, depth_m: np.ndarray) -> float:
    v, u = np.nonzero(pixels)
    z = depth_m[pixels]
    inverse = plane[0] * u + plane[1] * v + plane[2]
    distance = np.abs(z - 1.0 / np.maximum(inverse, 1e-3))
    return float(np.mean(distance < _FLAT_M + _FLAT_PER_M * z**2))


def _grow(mask: np.ndarray, by_px: int) -> np.ndarray:
    """Return `mask` (H, W) bool grown, or shrunk where `by_px` is negative."""
    kernel = np.ones((2 * abs(by_px) + 1,) * 2, np.uint8)
    if by_px >= 0:
        return cv2.dilate(mask.astype(np.uint8), kernel).astype(bool)
    # Outside counts as mask: the image's border is no edge of the object
    return cv2.erode(mask.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1).astype(bool)


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
