"""Optics that cost nothing: a wall 0.4 m away whose colour tells where one looks, and all kinds of faults."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np

from hal.base.clock import Clock, ManualClock
from hal.base.d405 import CaptureRequest, D405Calibration, Exposure
from hal.base.messages import Intrinsics

WALL_UNITS = 4000
_WAVES = 20.0


class PlainSource:
    """`hal.base.d405.FrameSource`."""

    def __init__(self, clock: Clock | None = None) -> None:
        self.clock = clock if clock is not None else ManualClock(100.0)
        self.lockstep = isinstance(self.clock, ManualClock)
        self.calibration = D405Calibration()
        self.attached = True
        self.looks: list[CaptureRequest] = []
        self.resets = self.closed = 0
        self.hangs = False
        """Gives nothing."""
        self.reset_cures = False
        self.restart_cures = False
        self.repeats = False
        """Gives the last frame again and again."""
        self.late_s = 0.0
        """Gives frames that old."""
        self.colour_stalls = False
        self._last: Exposure | None = None

    def expose(self, look: CaptureRequest) -> Exposure | None:
        self.looks.append(look)
        if look.number == 1 and self.restart_cures:
            self._cure()
        if self.hangs:
            return None
        if self.repeats and self._last is not None:
            return self._last
        depth, colour, rectified = (image.copy() for image in pictures(look.width, look.height))
        if look.brightness != 1.0:
            colour = np.clip(look.brightness * colour, 0, 255).astype(np.uint8)
        exposure = Exposure(
            number=look.number,
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


def tint(rays: np.ndarray) -> np.ndarray:
    """Return the wall's colour (…, 3) in directions (…, 3) of the depth axes: waves across, waves down, and grey."""
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    waves = np.stack([np.sin(_WAVES * x), np.sin(_WAVES * y), np.zeros_like(x)], axis=-1)
    return 128.0 + 100.0 * waves


def tint_slope(focal_px: float) -> float:
    """Return how much the colour changes a pixel where it changes fastest."""
    return 100.0 * _WAVES / focal_px


def pinhole_rays(pinhole: Intrinsics) -> np.ndarray:
    """Return the direction (H, W, 3) of every pixel."""
    v, u = np.mgrid[0 : pinhole.height, 0 : pinhole.width].astype(float)
    return np.stack([(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy, np.ones_like(u)], axis=-1)


@cache
def pictures(width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return depth (H, W), unrectified colour (H, W, 3) and the rectified picture (H, W, 3)."""
    calibration = D405Calibration()
    colour, depth = calibration.colour(width, height), calibration.depth(width, height)
    v, u = np.mgrid[0:height, 0:width].astype(float)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    rays = cv2.undistortPointsIter(
        pixels, colour.K, np.array(calibration.colour_coeffs), np.eye(3), np.eye(3), until
    ).reshape(height, width, 2)
    rays = np.dstack([rays, np.ones((height, width))]) @ calibration.R_colour_depth
    as_bytes = [np.round(tint(directions)).astype(np.uint8) for directions in (rays, pinhole_rays(depth))]
    return np.full((height, width), WALL_UNITS, np.uint16), as_bytes[0], as_bytes[1]
