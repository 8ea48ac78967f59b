"""How well a detector does: overlaps, hits and average precision."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from models.types import Detection
from sim_twin.detection_data.scenes import Label

_THRESHOLDS = np.linspace(0.5, 0.95, 10)


@dataclass(slots=True, kw_only=True)
class MatchedDetections:
    """What was found on some pictures, and what is there."""

    rows: list[tuple[np.ndarray, np.ndarray, float, int]] = field(default_factory=list)
    """Of each detection: its hits by box and by mask, see `match_detections`, its confidence and the number of its class."""
    targets: list[int] = field(default_factory=list)
    """The number of each object's class."""

    def average_precision(self, column: int) -> np.ndarray:
        """Return it (class, threshold), as ultralytics reckons it, by box (`column` 0) or by mask (1)."""
        from ultralytics.utils.metrics import ap_per_class

        hits, scores = np.array([row[column] for row in self.rows]), np.array([row[2] for row in self.rows])
        return ap_per_class(hits, scores, np.array([row[3] for row in self.rows]), np.array(self.targets))[5]


def match_detections(found: list[Detection], labels: tuple[Label, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return for each detection (N, 10) whether it hits a label, at each IoU from 0.5 to 0.95; by box and by mask.

    Each label is hit once, by the most confident detection of its class that overlaps enough.
    """
    boxes, masks = np.zeros((len(found), len(labels))), np.zeros((len(found), len(labels)))
    for row, detection in enumerate(found):
        for column, label in enumerate(labels):
            if detection.label == label.name:
                boxes[row, column] = box_iou(np.array(detection.box_px), label.box())
                if detection.mask is not None:
                    masks[row, column] = mask_iou(detection.mask, label.mask)
    return _hits(boxes), _hits(masks)


def _hits(ious: np.ndarray) -> np.ndarray:
    hits = np.zeros((len(ious), len(_THRESHOLDS)), dtype=bool)
    for number, threshold in enumerate(_THRESHOLDS):
        free = ious.copy()
        for row in range(len(ious)):  # the most confident first
            if free.shape[1] and free[row].max() >= threshold:
                hits[row, number] = True
                free[:, free[row].argmax()] = 0.0
    return hits


def box_iou(a: np.ndarray, b: np.ndarray) -> float:
    """Return the overlap of two boxes (4,): left, top, right, bottom."""
    shared = np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None).prod()
    return float(shared / ((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - shared))


def mask_iou(a: np.ndarray, b: np.ndarray) -> float:
    """Return the overlap of two masks (H, W) bool."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 0.0
