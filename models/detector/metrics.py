"""Metrics of a detector: overlaps, hits and average precision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from models.types import Detection

_IOU_THRESHOLDS = np.linspace(0.5, 0.95, 10)  # those of COCO's mAP50-95


class LabelledObject(Protocol):
    """Ground truth of one object in a picture."""

    @property
    def name(self) -> str:
        """Class name."""
        ...

    @property
    def mask(self) -> np.ndarray:
        """(H, W) bool, the object's visible pixels."""
        ...

    def box(self) -> np.ndarray:
        """Return (4,) left, top, right, bottom [px]."""
        ...


@dataclass(slots=True, kw_only=True)
class MatchedDetections:
    """Detections on some pictures, matched with their labels."""

    rows: list[tuple[np.ndarray, np.ndarray, float, int]] = field(default_factory=list)
    """For each detection: hits by box and by mask (`match_detections`), confidence, index of its class."""
    targets: list[int] = field(default_factory=list)
    """Index of the class of each labelled object."""

    def average_precision(self, column: int) -> np.ndarray:
        """Return the average precision (class, threshold) as ultralytics does, by box (`column` 0) or by mask (1)."""
        from ultralytics.utils.metrics import ap_per_class

        hits, scores = np.array([row[column] for row in self.rows]), np.array([row[2] for row in self.rows])
        return ap_per_class(hits, scores, np.array([row[3] for row in self.rows]), np.array(self.targets))[5]


def match_detections(found: Sequence[Detection], labels: Sequence[LabelledObject]) -> tuple[np.ndarray, np.ndarray]:
    """Return the hits (N, 10) of the detections at each IoU threshold from 0.5 to 0.95, by box and by mask.

    Each label is hit once, by the most confident detection of its class that overlaps enough.
    """
    boxes, masks = np.zeros((len(found), len(labels))), np.zeros((len(found), len(labels)))
    for row, detection in enumerate(found):
        for column, label in enumerate(labels):
            if detection.label == label.name:
                boxes[row, column] = box_iou(np.array(detection.box_px), label.box())
                if detection.mask is not None:
                    masks[row, column] = mask_iou(detection.mask, label.mask)
    return _assign_hits(boxes), _assign_hits(masks)


def _assign_hits(ious: np.ndarray) -> np.ndarray:
    hits = np.zeros((len(ious), len(_IOU_THRESHOLDS)), dtype=bool)
    for number, threshold in enumerate(_IOU_THRESHOLDS):
        free = ious.copy()
        for row in range(len(ious)):  # the most confident first
            if free.shape[1] and free[row].max() >= threshold:
                hits[row, number] = True
                free[:, free[row].argmax()] = 0.0
    return hits


def box_iou(a: np.ndarray, b: np.ndarray) -> float:
    """Return the intersection over union of two boxes (4,): left, top, right, bottom."""
    shared = np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None).prod()
    return float(shared / ((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - shared))


def mask_iou(a: np.ndarray, b: np.ndarray) -> float:
    """Return the intersection over union of two masks (H, W) bool."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 0.0
