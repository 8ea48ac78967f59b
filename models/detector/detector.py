"""YOLOv8 on colour images: class, confidence, box and, from a segmenting network, mask.

Input and output are converted by the same arithmetic for every runtime, as in ultralytics' predict(): letterbox with
grey 114, RGB, 1/255; non-maximum suppression within each class; masks are weighted sums of prototypes, scaled up,
thresholded at zero and cropped to the box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hal.base.errors import InvalidValueError
from models.detector.runtimes import RUNTIMES, open_network
from models.types import Detection

_GREY = 114  # ultralytics' border colour, with which the networks were trained
_STRIDES = (8, 16, 32)
"""Pixels from anchor to anchor, in the order of a YOLOv8's outputs; each level is in row order."""
_MAX_CANDIDATES = 1000
"""Boxes that enter the suppression; a trained network has some dozens above its threshold."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Letterbox:
    """Placement of an image in the network's input."""

    image_hw: tuple[int, int]
    """(H, W) of the image [px]."""
    input_hw: tuple[int, int]
    """(H, W) of the network's input [px]."""
    inner_hw: tuple[int, int]
    """(H, W) of the scaled image within it [px]."""
    top_left: tuple[int, int]
    """Rows above and columns left of the image [px]."""

    @classmethod
    def fit(cls, image_hw: tuple[int, int], input_hw: tuple[int, int]) -> Letterbox:
        """Return the placement of the largest image of the same proportions, in the middle of the input."""
        gain = min(input_hw[0] / image_hw[0], input_hw[1] / image_hw[1])
        inner = (max(round(image_hw[0] * gain), 1), max(round(image_hw[1] * gain), 1))
        # Rounded as ultralytics does, with an odd row at the bottom and an odd column on the right
        top, left = (round((whole - part) / 2 - 0.1) for whole, part in zip(input_hw, inner, strict=True))
        return cls(image_hw=image_hw, input_hw=input_hw, inner_hw=inner, top_left=(top, left))

    def blob(self, image: np.ndarray) -> np.ndarray:
        """Return `image` (H, W, 3) uint8 RGB as the network's input (1, 3, H, W) float32 in [0, 1]."""
        if self.inner_hw != self.image_hw:
            image = cv2.resize(image, self.inner_hw[::-1], interpolation=cv2.INTER_LINEAR)
        if self.inner_hw != self.input_hw:
            (top, left), (height, width) = self.top_left, self.inner_hw
            bottom, right = self.input_hw[0] - top - height, self.input_hw[1] - left - width
            image = cv2.copyMakeBorder(image, top, bottom, left, right, cv2.BORDER_CONSTANT, value=(_GREY,) * 3)
        return cv2.dnn.blobFromImage(image, 1.0 / 255.0)

    def to_image(self, boxes: np.ndarray) -> np.ndarray:
        """Return `boxes` (N, 4) of the input as boxes of the image, clipped to its border [px]."""
        top, left = self.top_left
        height, width = self.image_hw
        gain_v, gain_u = self.inner_hw[0] / height, self.inner_hw[1] / width  # not quite equal: both sizes were rounded
        boxes = (boxes - [left, top, left, top]) / [gain_u, gain_v, gain_u, gain_v]
        return np.clip(boxes, 0, [width, height, width, height])

    def mask(self, logits: np.ndarray) -> np.ndarray:
        """Return the mask (H, W) bool over the image of positive `logits` (h, w) over the whole input."""
        if self.input_hw != self.image_hw:
            (top, left), (height, width) = self.top_left, self.inner_hw
            logits = cv2.resize(logits, self.input_hw[::-1], interpolation=cv2.INTER_LINEAR)
            logits = logits[top : top + height, left : left + width]
        return cv2.resize(logits, self.image_hw[::-1], interpolation=cv2.INTER_LINEAR) > 0.0


def read_outputs(
    rows: np.ndarray,
    prototypes: np.ndarray | None,
    names: tuple[str, ...],
    letterbox: Letterbox,
    *,
    min_confidence: float,
    max_iou: float,
    max_detections: int,
    every_class: bool = False,
) -> list[Detection]:
    """Return the detections in the network's outputs, most confident first.

    Args:
        rows: (4 + C + M, A) one column an anchor: centre and size of its box in the input [px], C confidences, M
            weights of the prototypes.
        prototypes: (M, h, w) of the masks; None from a network without.
        names: the C classes.
        letterbox: placement of the image in the input.
        min_confidence: minimum confidence, exclusive.
        max_iou: of two boxes of a class that overlap more than this, the less confident is dropped.
        max_detections: maximum number returned.
        every_class: each class of an anchor is a detection of its own, not the likeliest alone.
    """
    scores = rows[4 : 4 + len(names)]
    classes, anchors = _select_candidates(scores, min_confidence, every_class)
    corners = _to_corners(rows[:4, anchors].T)
    kept = _suppress_overlaps(corners, scores[classes, anchors], classes, max_iou)[:max_detections]
    boxes = letterbox.to_image(corners[kept])
    found = []
    for number, anchor, box in zip(classes[kept], anchors[kept], boxes, strict=True):
        mask = None
        if prototypes is not None:
            weights = rows[4 + len(names) :, anchor]
            mask = _crop_mask(letterbox.mask(np.tensordot(weights, prototypes, axes=1).astype(np.float32)), box)
        edges = _grow_to_pixels(box)
        if edges[0] >= edges[2] or edges[1] >= edges[3] or (mask is not None and not mask.any()):
            continue  # outside of the image, or an empty mask
        confidence = float(scores[number, anchor])
        found.append(Detection(label=names[number], confidence=confidence, box_px=edges, mask=mask))
    return found


def count_anchors(input_hw: tuple[int, int]) -> int:
    """Return the number of anchors of a YOLOv8 for an input (H, W) [px]."""
    return sum((input_hw[0] // stride) * (input_hw[1] // stride) for stride in _STRIDES)


def average_mirrored(rows: np.ndarray, mirrored: np.ndarray, n_classes: int, input_hw: tuple[int, int]) -> np.ndarray:
    """Return the mean of a network's outputs for an input and for its mirror image.

    Boxes and confidences are averaged anchor by anchor, each with the anchor at the mirrored position. The weights of
    the prototypes are kept: those of the mirror image belong to its own prototypes.

    Args:
        rows: (4 + C + M, A) of the input, see `read_outputs`.
        mirrored: (4 + C + M, A) of the input mirrored left to right.
        n_classes: C.
        input_hw: (H, W) of the input [px].
    """
    height, width = input_hw
    n_rows, levels, first = 4 + n_classes, [], 0
    for stride in _STRIDES:
        h, w = height // stride, width // stride
        level = mirrored[:n_rows, first : first + h * w].reshape(n_rows, h, w)
        levels.append(level[..., ::-1].reshape(n_rows, h * w))
        first += h * w
    back = np.concatenate(levels, axis=1)
    back[0] = width - back[0]
    mean = rows.copy()
    mean[:n_rows] = (rows[:n_rows] + back) / 2
    return mean


def _select_candidates(scores: np.ndarray, min_confidence: float, every_class: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return classes and anchors with `scores` (C, A) above the minimum, most confident first."""
    anchors = np.flatnonzero(scores.max(axis=0) > min_confidence)
    classes = scores[:, anchors].argmax(axis=0)
    if every_class:
        classes, anchors = np.nonzero(scores > min_confidence)
    order = np.argsort(-scores[classes, anchors], kind="stable")[:_MAX_CANDIDATES]
    return classes[order], anchors[order]


def _suppress_overlaps(corners: np.ndarray, scores: np.ndarray, classes: np.ndarray, max_iou: float) -> np.ndarray:
    """Return indices of the boxes `corners` (N, 4) that remain after suppression per class, most confident first."""
    if not len(corners):
        return np.empty(0, dtype=int)
    boxes = np.concatenate([corners[:, :2], corners[:, 2:] - corners[:, :2]], axis=1)
    kept = cv2.dnn.NMSBoxesBatched(boxes.tolist(), scores.tolist(), classes.tolist(), 0.0, max_iou)
    return np.sort(np.asarray(kept, dtype=int).reshape(-1))


def _to_corners(boxes: np.ndarray) -> np.ndarray:
    """Return (N, 4) boxes given by centre and size as (u_min, v_min, u_max, v_max)."""
    boxes = boxes.astype(float)
    return np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], axis=1)


def _crop_mask(mask: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return `mask` (H, W) cropped to `box` (u_min, v_min, u_max, v_max)."""
    u_min, v_min, u_max, v_max = (int(edge) for edge in np.ceil(box))
    cut = np.zeros_like(mask)
    cut[v_min:v_max, u_min:u_max] = mask[v_min:v_max, u_min:u_max]
    return cut


def _grow_to_pixels(box: np.ndarray) -> tuple[int, int, int, int]:
    """Return `box` grown to whole pixels, upper ends exclusive."""
    u_min, v_min = np.floor(box[:2]).astype(int)
    u_max, v_max = np.ceil(box[2:]).astype(int)
    return int(u_min), int(v_min), int(u_max), int(v_max)


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
        if self.runtime not in ("auto", *RUNTIMES):
            raise InvalidValueError(
                f"detector: runtime is {self.runtime!r}; allowed is auto, {', '.join(RUNTIMES)}.",
                code="unknown_runtime",
            )
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
