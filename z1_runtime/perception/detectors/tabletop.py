"""Detector for whatever rises above the table, by depth alone."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from hal.base.messages import RgbdFrame
from hal.base.transforms import transform_points
from models.types import Detection
from z1_runtime.perception.detector import mask_box
from z1_runtime.perception.point_cloud import back_project, continuous_pixels, inside_box, valid_pixels
from z1_runtime.perception.table_plane import TableConfig, expected_table, fit_table

_BORDER_PX = 3  # stereo matches windows, not pixels: the outermost ones stay unmeasured


@dataclass(frozen=True, slots=True, kw_only=True)
class TabletopConfig:
    """Criteria of an object on the table."""

    d_max_m: float = 1.0
    """Maximum depth [m]."""
    workspace_lower_m: tuple[float, float, float] = (0.28, -0.30, 0.0)
    """Lower corner of the workspace [m]: x and y in the base frame, the third is height above the table."""
    workspace_upper_m: tuple[float, float, float] = (0.70, 0.30, 0.40)
    """Upper corner [m]."""
    min_height_m: float = 0.005
    """Minimum height of an object's points above the table [m]; larger where the depth noise is larger."""
    cell_m: float = 0.005
    """Cell size of the footprint grid [m]."""
    min_cell_points: int = 3
    """Minimum number of points in a cell; flying pixels and noise are thinner."""
    join_m: float = 0.015
    """Maximum gap in the footprint of one object [m]; a wider one separates two objects."""
    min_area_m2: float = 2e-4
    """Minimum visible area, as seen from the camera [m²]."""
    typical_area_m2: float = 5e-4
    """Visible area at which confidence is one half [m²]."""
    border_confidence: float = 0.3
    """Factor on the confidence of an object that the border of the depth image cuts: too little of it is visible."""
    table: TableConfig = field(default_factory=TableConfig)
    """Search for the table plane."""


class TabletopDetector:
    """Detector of any object on the table, by depth alone; the largest visible area comes first.

    Points above the table are projected onto it and clustered by their footprint, which joins the pieces of one object
    that holes in the depth separate: everything above the table rests on it.
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
        valid = valid_pixels(frame.depth_m, config.d_max_m) & continuous_pixels(frame.depth_m)
        points = back_project(frame.depth_m, frame.intrinsics, valid)
        table = fit_table(points, expected_table(T_base_camera), config.table)
        p_base = transform_points(T_base_camera, points)
        p_base[:, 2] = table.plane.height_m(points)  # independent of a table off z = 0 and of errors of the extrinsics
        inside = inside_box(p_base, np.array(config.workspace_lower_m), np.array(config.workspace_upper_m))
        inside &= table.above(points, config.min_height_m)
        index = np.flatnonzero(inside)
        labels = self._footprint_labels(p_base[index])
        pixels = np.flatnonzero(valid)[index]
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
        # Dilation by half the gap makes cells closer than the gap touch.
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
        # Only unmeasured pixels are filled in: a measured one inside the outline is the table or a neighbour.
        whole = mask.astype(bool) | (filled.astype(bool) & (depth_m == 0))
        confidence = visible_m2 / (visible_m2 + config.typical_area_m2)
        if _is_cut(whole, depth_m):
            confidence *= config.border_confidence
        return Detection(label="object", confidence=confidence, box_px=mask_box(whole), mask=whole)


def _is_cut(mask: np.ndarray, depth_m: np.ndarray) -> bool:
    """Return whether the object leaves the image, or enters the band on the left that only one imager sees."""
    u_min, v_min, u_max, v_max = mask_box(mask)
    height, width = mask.shape
    if min(u_min, v_min, width - u_max, height - v_max) < _BORDER_PX:
        return True
    # The band is as wide as the disparity, hence wider for near objects: it ends at the leftmost measured pixel.
    rows = slice(v_min, v_max)
    at_band = mask[rows].argmax(axis=1) <= (depth_m[rows] > 0).argmax(axis=1)
    return bool((at_band & mask[rows].any(axis=1)).mean() > 0.05)
