"""Who finds the object in the image: a contract, and three who keep it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np

from hal.base.errors import InvalidValueError
from hal.base.messages import RgbdFrame
from hal.base.transforms import transform_points
from models.detector.detector import YoloConfig, YoloModel
from models.types import Detection
from models.weights_file import WeightsError
from z1_runtime.perception.mask_refinement import lies_flat, trimmed
from z1_runtime.perception.point_cloud import PerceptionError, back_project, continuous_pixels, inside_box, valid_pixels
from z1_runtime.perception.table_plane import TableConfig, expected_table, fit_table

_LOG = logging.getLogger(__name__)
_BORDER_PX = 3  # stereo matches windows, not pixels: the outermost ones stay unmeasured


class Detector(Protocol):
    """Finds objects in a frame."""

    classes: tuple[str, ...]
    """Labels it can tell apart; empty when it knows no classes."""
    min_confidence: float
    """What is not above this does not count; `detect` may return it, to tell what was nearly seen."""

    def detect(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> list[Detection]:
        """Return what was found, most confident first; empty when there is nothing.

        Args:
            frame: the image; where it showed the robot's own gripper its depth is 0.
            T_base_camera: (4, 4) camera pose when it was taken.

        Raises:
            PerceptionError: the frame cannot be used.
        """
        ...


def mask_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Return (u_min, v_min, u_max, v_max) of the (H, W) bool `mask`, upper ends exclusive [px]."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


class GroundTruthDetector:
    """The twin's own mask, for evaluation: it shows what the rest does when detection is perfect."""

    classes: tuple[str, ...] = ()
    min_confidence: float = 0.0

    def detect(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> list[Detection]:
        """Return the one object of the truth mask; see `Detector.detect`."""
        if frame.ground_truth_mask is None:
            raise PerceptionError("only the twin's frames carry a truth mask; use --detector tabletop.")
        if not frame.ground_truth_mask.any():
            return []
        mask = frame.ground_truth_mask
        return [Detection(label="object", confidence=1.0, box_px=mask_box(mask), mask=mask)]


@dataclass(frozen=True, slots=True, kw_only=True)
class TabletopConfig:
    """What counts as an object on the table."""

    d_max_m: float = 1.0
    """Depth beyond this is ignored [m]."""
    workspace_lower_m: tuple[float, float, float] = (0.28, -0.30, 0.0)
    """Lower corner of where objects may be [m]: x and y in the base frame, the third is height above the table."""
    workspace_upper_m: tuple[float, float, float] = (0.70, 0.30, 0.40)
    """Upper corner [m]."""
    min_height_m: float = 0.005
    """Points lower than this above the table are table [m]; more where the depth noise is more."""
    cell_m: float = 0.005
    """Cell of the footprint grid [m]."""
    min_cell_points: int = 3
    """Points a cell needs; flying pixels and noise are thinner."""
    join_m: float = 0.015
    """Gaps in the footprint narrower than this are bridged [m]; wider ones part two objects."""
    min_area_m2: float = 2e-4
    """Smallest visible area, as seen from the camera [m²]."""
    typical_area_m2: float = 5e-4
    """Visible area at which confidence is one half [m²]."""
    border_confidence: float = 0.3
    """Factor on the confidence of what the border of the depth image cuts: clutter, or too little is seen of it."""
    table: TableConfig = field(default_factory=TableConfig)


class TabletopDetector:
    """Whatever stands on the table, by depth alone; the largest visible area comes first.

    Points above the table are dropped onto it and clustered by their footprint, which joins the pieces that holes in
    the depth cut out of one object: what is above the table rests on it.
    """

    classes: tuple[str, ...] = ()
    min_confidence: float = 0.0

    def __init__(self, config: TabletopConfig | None = None) -> None:
        self._config = config or TabletopConfig()

    def detect(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> list[Detection]:
        """Return the objects on the table; see `Detector.detect`.

        Raises:
            NoTableError: the table is not in view.
        """
        config = self._config
        seen = valid_pixels(frame.depth_m, config.d_max_m) & continuous_pixels(frame.depth_m)
        points = back_project(frame.depth_m, frame.intrinsics, seen)
        table = fit_table(points, expected_table(T_base_camera), config.table)
        p_base = transform_points(T_base_camera, points)
        p_base[:, 2] = table.plane.height_m(points)  # a table off z = 0, or a hand-eye error, shall not matter
        standing = inside_box(p_base, np.array(config.workspace_lower_m), np.array(config.workspace_upper_m))
        standing &= table.above(points, config.min_height_m)
        index = np.flatnonzero(standing)
        labels = self._footprint_labels(p_base[index])
        pixels = np.flatnonzero(seen)[index]
        area = points[index, 2] ** 2 / (frame.intrinsics.fx * frame.intrinsics.fy)
        found = []
        for label in range(1, int(labels.max(initial=0)) + 1):
            member = labels == label
            if (visible_m2 := float(area[member].sum())) >= config.min_area_m2:
                found.append(self._detection(pixels[member], visible_m2, frame.depth_m))
        return sorted(found, key=lambda detection: -detection.confidence)

    def _footprint_labels(self, p_base: np.ndarray) -> np.ndarray:
        """Return the (N,) cluster numbers of points by their x, y; 0 = none."""
        config = self._config
        lower, upper = np.array(config.workspace_lower_m[:2]), np.array(config.workspace_upper_m[:2])
        shape = np.ceil((upper - lower) / config.cell_m).astype(int) + 1
        column = ((p_base[:, :2] - lower) / config.cell_m).astype(int)
        cell = np.ravel_multi_index((column[:, 0], column[:, 1]), tuple(shape))
        filled = (np.bincount(cell, minlength=shape.prod()) >= config.min_cell_points).reshape(shape)
        # Growing every cell by half the gap makes those closer than the gap touch.
        grow = 2 * round(config.join_m / config.cell_m / 2) + 1
        bridged = cv2.dilate(filled.astype(np.uint8), np.ones((grow, grow), np.uint8))
        _, numbers = cv2.connectedComponents(bridged, connectivity=8)
        return numbers.reshape(-1)[cell]

    def _detection(self, pixels: np.ndarray, visible_m2: float, depth_m: np.ndarray) -> Detection:
        config = self._config
        mask = np.zeros(depth_m.shape, np.uint8)
        mask.reshape(-1)[pixels] = 1
        closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9)))
        outlines, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        filled = cv2.drawContours(np.zeros_like(mask), outlines, -1, 1, thickness=cv2.FILLED)
        # Only what was not measured is filled in: a measured pixel inside the outline is the table or a neighbour.
        whole = mask.astype(bool) | (filled.astype(bool) & (depth_m == 0))
        confidence = visible_m2 / (visible_m2 + config.typical_area_m2)
        if _is_cut(whole, depth_m):
            confidence *= config.border_confidence
        return Detection(label="object", confidence=confidence, box_px=mask_box(whole), mask=whole)


def _is_cut(mask: np.ndarray, depth_m: np.ndarray) -> bool:
    """Return whether the object runs out of the image, or into the band on the left that only one imager sees."""
    u_min, v_min, u_max, v_max = mask_box(mask)
    height, width = mask.shape
    if min(u_min, v_min, width - u_max, height - v_max) < _BORDER_PX:
        return True
    # The band is as wide as the disparity, hence wider for what is near: it is found as "nothing further left".
    rows = slice(v_min, v_max)
    at_band = mask[rows].argmax(axis=1) <= (depth_m[rows] > 0).argmax(axis=1)
    return bool((at_band & mask[rows].any(axis=1)).mean() > 0.05)


class YoloDetector:
    """What YOLOv8 sees in the colour image, its masks held against the depth."""

    def __init__(self, config: YoloConfig | None = None) -> None:
        """Load the network; errors as `models.detector.detector.YoloModel`."""
        self._detector = YoloModel(config)
        self.classes = self._detector.classes
        self.min_confidence = self._detector.config.min_confidence
        self.runtime = self._detector.runtime

    def detect(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> list[Detection]:
        """Return the objects in the colour image, also the faint ones, but none that is flat; see `Detector.detect`."""
        del T_base_camera
        found = self._detector.detect(frame.colour, min(_FAINT, self.min_confidence))
        return [trimmed(d, frame.depth_m) for d in found if not self._is_flat(d, frame.depth_m)]

    def _is_flat(self, detection: Detection, depth_m: np.ndarray) -> bool:
        flat = lies_flat(detection, depth_m)
        if flat and detection.confidence > self.min_confidence:
            _LOG.warning(
                "what looks like a %s (confidence %.2f) lies in the plane around it, so it is taken for a pattern; if "
                "it is a thing, look from lower down, or use --detector tabletop.",
                detection.label,
                detection.confidence,
            )
        return flat


_FAINT = 0.1
"""Confidence from which on something is worth a word when nothing better was seen."""


_DETECTORS: dict[str, Callable[[YoloConfig], Detector]] = {
    "tabletop": lambda _: TabletopDetector(),
    "truth": lambda _: GroundTruthDetector(),
    "yolo": YoloDetector,
}
DETECTORS = tuple(_DETECTORS)
"""The detectors by name."""


def make_detector(name: str, yolo: YoloConfig | None = None) -> Detector:
    """Return the detector of that name; `yolo` is for the one that learned.

    Raises:
        ValueError: no such name; the message lists the known ones. Or the learned one's weights are missing or wrong.
    """
    if name not in _DETECTORS:
        raise InvalidValueError(f"there is no detector {name!r}; known: {', '.join(sorted(_DETECTORS))}.")
    try:
        return _DETECTORS[name](yolo or YoloConfig())
    except WeightsError as err:
        raise WeightsError(f"{err} Without weights: --detector tabletop.") from err
