"""Metrics of a detector: hits and overlaps."""

from __future__ import annotations

import numpy as np
import pytest

from models.detector.metrics import box_iou, mask_iou, match_detections
from models.types import Detection
from sim_twin.detection_data.scenes import Label

SHAPE = (480, 640)


def rectangle(left: int, top: int, right: int, bottom: int) -> np.ndarray:
    mask = np.zeros(SHAPE, dtype=bool)
    mask[top:bottom, left:right] = True
    return mask


def detection(name: str, mask: np.ndarray, confidence: float) -> Detection:
    left, top, right, bottom = (int(side) for side in Label(name=name, mask=mask).box())
    return Detection(label=name, confidence=confidence, box_px=(left, top, right, bottom), mask=mask)


def test_a_label_is_hit_once_by_the_most_confident_detection() -> None:
    mask = rectangle(100, 100, 200, 200)
    found = [detection("box", mask, 0.9), detection("box", mask, 0.8)]
    by_box, by_mask = match_detections(found, (Label(name="box", mask=mask),))
    assert by_box[0].all() and by_mask[0].all()
    assert not by_box[1].any() and not by_mask[1].any()


def test_overlaps_are_intersection_over_union() -> None:
    a, b = rectangle(0, 0, 100, 100), rectangle(50, 0, 150, 100)
    assert mask_iou(a, b) == pytest.approx(1 / 3)
    assert box_iou(np.array([0, 0, 100, 100]), np.array([50, 0, 150, 100])) == pytest.approx(1 / 3)
    assert box_iou(np.array([0, 0, 10, 10]), np.array([20, 20, 30, 30])) == 0.0
    assert mask_iou(np.zeros(SHAPE, dtype=bool), np.zeros(SHAPE, dtype=bool)) == 0.0
