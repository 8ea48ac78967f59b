"""Cheap optics with fault injection: a wall at 0.4 m whose colour encodes the viewing direction."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np

from hal.base.clock import Clock, ManualClock
from hal.base.d405 import CaptureRequest, D405Calibration, Exposure

WALL_UNITS = 4000
_WAVES = 20.0


class PlainSource:
    """`hal.base.d405.FrameSource`."""

    def __init__(self, clock: Clock | None = None) -> None:
        self.clock = clock if clock is not None else ManualClock(100.0)
        self.lockstep = isinstance(self.clock, ManualClock)
        self.calibration = D405Calibration()
        self.attached = True
        self.requests: list[CaptureRequest] = []
        self.resets = self.closed = 0
        self.hangs = False
        """Delivers nothing."""
        self.reset_cures = False
        self.restart_cures = False
        self.repeats = False
        """Repeats the last frame."""
        self.late_s = 0.0
        """Age of the frames [s]."""
        self.colour_stalls = False
        self._last: Exposure | None = None

    def expose(self, request: CaptureRequest) -> Exposure | None:
        self.requests.append(request)
        if request.number == 1 and self.restart_cures:
            self._cure()
        if self.hangs:
            return None
        if self.repeats and self._last is not None:
            return self._last
        depth, colour, rectified = (image.copy() for image in make_images(request.width, request.height))
        if request.brightness != 1.0:
            colour = np.clip(request.brightness * colour, 0, 255).astype(np.uint8)
        exposure = Exposure(
            number=request.number,
            stamp_s=self.clock.now_s() - self.late_s,
            depth=depth,
            colour=colour,
            left=rectified,
            right=255 - rectified,
        )
        self._last = exposure
        return replace(exposure, colour=None) if self.colour_stalls else exposure

    def reset(self) -> None:
        self.resets += 1
        if self.reset_cures:
            self._cure()

    def close(self) -> None:
        self.closed += 1

    def _cure(self) -> None:
        self.hangs = self.repeats = False


def wall_colour(rays: np.ndarray) -> np.ndarray:
    """Return the wall's colour (…, 3) in directions (…, 3) of the depth axes: waves across, waves down, and grey."""
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    waves = np.stack([np.sin(_WAVES * x), np.sin(_WAVES * y), np.zeros_like(x)], axis=-1)
    return 128.0 + 100.0 * waves


def colour_slope(focal_px: float) -> float:
    """Return the maximum change of the colour per pixel."""
    return 100.0 * _WAVES / focal_px


@cache
def make_images(width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return depth (H, W), unrectified colour (H, W, 3) and the rectified image (H, W, 3)."""
    calibration = D405Calibration()
    colour, depth = calibration.colour(width, height), calibration.depth(width, height)
    v, u = np.mgrid[0:height, 0:width].astype(float)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    rays = cv2.undistortPointsIter(
        pixels, colour.K, np.array(calibration.colour_coeffs), np.eye(3), np.eye(3), until
    ).reshape(height, width, 2)
    rays = np.dstack([rays, np.ones((height, width))]) @ calibration.R_colour_depth
    as_bytes = [np.round(wall_colour(directions)).astype(np.uint8) for directions in (rays, depth.rays())]
    return np.full((height, width), WALL_UNITS, np.uint16), as_bytes[0], as_bytes[1]
