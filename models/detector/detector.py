"""YOLOv8 finds objects in a colour image: class, confidence, box and, where the network knows it, mask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hal.base.errors import InvalidValueError
from models.detector.image import Letterbox, mean_of_mirrored, n_anchors, read_outputs
from models.detector.runtimes import open_network
from models.types import Detection

_STANDS_FOR = {"cylinder": ("cup", "vase"), "box": ("book", "suitcase")}
"""COCO's names for what its networks see in our classes, for networks that lack ours."""


@dataclass(frozen=True, slots=True, kw_only=True)
class YoloConfig:
    """Which network, and what of its output counts."""

    weights: Path | None = None
    """.npz of ours, .pt of ultralytics, .onnx, OpenVINO's .xml or its folder; None is the shipped one."""
    runtime: str = "auto"
    """`openvino`, `onnxruntime` or `torch`; `auto` is the first of these that is installed."""
    min_confidence: float = 0.5
    """What is not above this is not seen, in [0, 1)."""
    max_iou: float = 0.5
    """Of two boxes of a class that overlap more, the less confident is dropped. Ultralytics' own value, 0.7, leaves
    second boxes of one object: on 300 pictures of no other use box mAP50 is 0.972 with it, 0.974 with this."""
    max_detections: int = 20
    """Most objects of an image."""
    every_class: bool = False
    """Each class that may be at a place counts as a detection of its own, as mean average precision is reckoned; else
    the likeliest alone."""
    mirrored: bool = True
    """It looks at the mirror image as well and takes the mean of both: fewer errors for twice the time (figures in
    `models/weights/README.md`). Networks whose anchors do not lie as YOLOv8's do look once."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.min_confidence < 1.0:
            raise InvalidValueError(f"min_confidence is {self.min_confidence}; allowed is 0 up to, but not, 1.")
        if not 0.0 < self.max_iou <= 1.0:
            raise InvalidValueError(f"max_iou is {self.max_iou}; allowed is above 0, up to 1.")
        if self.max_detections < 1:
            raise InvalidValueError(f"max_detections is {self.max_detections}; allowed is 1 or more.")


class YoloModel:
    """Finds objects by a YOLOv8 (or 11) that detects or segments. Safe to call from several threads."""

    def __init__(self, config: YoloConfig | None = None) -> None:
        """Load the network.

        Raises:
            WeightsError: the file is missing, damaged, or holds no detector that is understood.
            ValueError: the runtime is unknown, not installed, or cannot run this kind of file.
        """
        self.config = config or YoloConfig()
        self._network = open_network(self.config.weights, self.config.runtime)
        self.runtime = self._network.runtime
        self.classes = self._network.names

    def detect(self, image: np.ndarray, min_confidence: float | None = None) -> list[Detection]:
        """Return the objects in `image` (H, W, 3) uint8 RGB, most confident first.

        Args:
            image: the image.
            min_confidence: in place of the configuration's.

        Raises:
            ValueError: the image has another shape or type.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
            raise InvalidValueError(f"the detector takes (H, W, 3) uint8 RGB; got {image.shape} {image.dtype}.")
        letterbox = Letterbox.fit(image.shape[:2], self._network.input_hw)
        blob = letterbox.blob(image)
        rows, prototypes = self._network.run(blob)
        if self.config.mirrored and rows.shape[1] == n_anchors(self._network.input_hw):
            mirrored, _ = self._network.run(np.ascontiguousarray(blob[..., ::-1]))
            rows = mean_of_mirrored(rows, mirrored, len(self.classes), self._network.input_hw)
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
    """Return which of a detector's `classes` are the `wanted` one: itself, or else what stands for it in COCO.

    Raises:
        ValueError: none is; the message lists what the detector knows.
    """
    labels = (wanted,) if wanted in classes else tuple(c for c in _STANDS_FOR.get(wanted, ()) if c in classes)
    if not labels:
        raise InvalidValueError(f"the detector does not know {wanted!r}; it knows: {', '.join(classes)}.")
    return labels


def best_of(found: Sequence[Detection], labels: Sequence[str]) -> Detection | None:
    """Return the most confident of `found` with one of `labels`, as the paper does; None when there is none."""
    return max((d for d in found if d.label in labels), key=lambda d: d.confidence, default=None)
