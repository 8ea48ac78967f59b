"""Interface of all detectors."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from hal.base.messages import RgbdFrame
from models.types import Detection


class Detector(Protocol):
    """Detector of objects in a frame."""

    classes: tuple[str, ...]
    """Labels that it distinguishes; empty without classes."""
    min_confidence: float
    """Detections must be above this; `detect` may return fainter ones, for the error message."""

    def detect(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> list[Detection]:
        """Return the detections, most confident first; empty when there is none.

        Args:
            frame: the image; its depth is 0 where it shows the robot's own gripper.
            T_base_camera: (4, 4) camera pose when it was taken.

        Raises:
            PerceptionError: the frame cannot be used.
        """
        ...


def mask_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Return (u_min, v_min, u_max, v_max) of the (H, W) bool `mask`, upper ends exclusive [px]."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
