"""YOLOv8 object detector for colour images: class, confidence, box and, from a segmenting network, mask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hal.base.errors import InvalidValueError
from models.detector.image import Letterbox, average_mirrored, count_anchors, read_outputs
from models.detector.runtimes import open_network
from models.types import Detection

_COCO_EQUIVALENTS = {"cylinder": ("cup", "vase"), "box": ("book", "suitcase")}
"""COCO classes in place of this project's, for networks without the latter."""


@dataclass(frozen=True, slots=True, kw_only=True)
class YoloConfig:
    """Network, and the limits on its output."""

    weights: Path | None = None
    """This project's .npz, ultralytics' .pt, .onnx, OpenVINO's .xml or its folder; None is the shipped file."""
    runtime: str = "auto"
    """`openvino`, `onnxruntime` or `torch`; `auto` is the first of these that is installed."""
    min_confidence: float = 0.5
    """Minimum confidence of a detection, exclusive, in [0, 1)."""
    max_iou: float = 0.5
    """Of two boxes of a class that overlap more, the less confident is dropped. Ultralytics' own value, 0.7, leaves
    second boxes of one object: on 300 separate pictures box mAP50 is 0.972 with it, 0.974 with this."""
    max_detections: int = 20
    """Maximum number of objects in an image."""
    every_class: bool = False
    """Each class of an anchor counts as a detection of its own, as in mean average precision; else the likeliest
    alone."""
    mirrored: bool = True
    """The mirror image is processed as well and both results averaged: fewer errors for twice the time (figures in
    `models/weights/README.md`). Networks with another anchor layout than YOLOv8's process the image alone."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.min_confidence < 1.0:
            raise InvalidValueError(
                f"detector: min_confidence is {self.min_confidence}; allowed is 0 up to, but not, 1.",
                code="detector_confidence",
            )
        if not 0.0 < self.max_iou <= 1.0:
            raise InvalidValueError(
                f"detector: max_iou is {self.max_iou}; allowed is above 0, up to 1.", code="detector_iou"
            )
        if self.max_detections < 1:
            raise InvalidValueError(
                f"detector: max_detections is {self.max_detections}; allowed is 1 or more.", code="detector_count"
            )


class YoloModel:
    """Object detector by a YOLOv8 (or 11) that detects or segments. Safe to call from several threads."""

    def __init__(self, config: YoloConfig | None = None) -> None:
        """Load the network.

        Raises:
            WeightsError: the file is missing, damaged, or holds no supported detector.
            InvalidValueError: the runtime is unknown, not installed, or cannot run this kind of file.
        """
        self.config = config or YoloConfig()
        self._network = open_network(self.config.weights, self.config.runtime)
        self.runtime = self._network.runtime
        self.classes = self._network.names

    def detect(self, image: np.ndarray, min_confidence: float | None = None) -> list[Detection]:
        """Return the objects in `image` (H, W, 3) uint8 RGB, most confident first.

        Args:
            image: the image.
            min_confidence: replaces the configuration's.

        Raises:
            InvalidValueError: the image has another shape or type.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
            raise InvalidValueError(
                f"detector: takes (H, W, 3) uint8 RGB; got {image.shape} {image.dtype}.", code="image_type"
            )
        letterbox = Letterbox.fit(image.shape[:2], self._network.input_hw)
        blob = letterbox.blob(image)
        rows, prototypes = self._network.run(blob)
        if self.config.mirrored and rows.shape[1] == count_anchors(self._network.input_hw):
            # A copy, as torch takes no array with negative strides
            mirrored, _ = self._network.run(np.ascontiguousarray(blob[..., ::-1]))
            rows = average_mirrored(rows, mirrored, len(self.classes), self._network.input_hw)
        return read_outputs(
            rows,
            prototypes,
            self.classes,
            letterbox,
            min_confidence=self.config.min_confidence if min_confidence is None else min_confidence,
            max_iou=self.config.max_iou,
            max_detections=self.config.max_detections,
            every_class=self.config.every_class,
        )


def labels_for(wanted: str, classes: Sequence[str]) -> tuple[str, ...]:
    """Return the detector's `classes` for the `wanted` one: itself, or else its equivalents in COCO.

    Raises:
        InvalidValueError: there is none; the message lists the detector's classes.
    """
    labels = (wanted,) if wanted in classes else tuple(c for c in _COCO_EQUIVALENTS.get(wanted, ()) if c in classes)
    if not labels:
        raise InvalidValueError(
            f"the detector does not know {wanted!r}; it knows: {', '.join(classes)}.", code="unknown_class"
        )
    return labels


def best_of(found: Sequence[Detection], labels: Sequence[str]) -> Detection | None:
    """Return the most confident of `found` with one of `labels`, as in the paper; None when there is none."""
    return max((d for d in found if d.label in labels), key=lambda d: d.confidence, default=None)
