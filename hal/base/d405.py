"""The RealSense D405: its facts with their sources, and the contract of a simulated or recorded source of its frames.

Sources: the D400 datasheet (DigiKey 50822), librealsense's d400 sources, and what real units reported in
librealsense's issue tracker (#11044, #11219, #12918) and in realsense-ros #3289.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from hal.base.clock import Clock
from hal.base.messages import Intrinsics

NAME = "Intel RealSense D405"
USB_VENDOR, USB_PRODUCT = "8086", "0B5B"
PRODUCT_LINE = "D400"
FIRMWARE = "5.15.1.55"  # of two real units
SENSOR = "Stereo Module"
"""Name of the only sensor; colour, depth and infrared all come from it, and there is no "RGB Camera"."""
DEPTH_UNIT_M = 1e-4
"""Depth unit of a new device [m]; drivers read it from the device, never from here."""
BASELINE_M = 0.018  # datasheet; real units report 17.9 to 18.1 mm
EXPOSURE_US = (1, 165_000, 33_000)
"""Minimum, maximum, default [µs]."""
GAIN = (16, 248, 16)
"""Minimum, maximum, default."""
ASIC_C = 35.0
"""Temperature of a twin [°C]; real units are specified up to 35 °C ambient, and are unreliable from about 42 °C."""
RESET_S = 2.0
"""Approximate time off the bus after a hardware reset [s]."""

MIN_Z_M = {
    (848, 480): 0.070,
    (1280, 720): 0.100,
    (640, 480): 0.070,
    (640, 360): 0.055,
    (480, 270): 0.045,
    (424, 240): 0.040,
}
"""Minimum distance with a stereo match for every resolution (width, height) [px], the default first (datasheet; at
640×480 depth was observed to break up below 70 mm)."""


def rates_hz(width: int, height: int) -> tuple[int, ...]:
    """Return the frame rates [Hz] over USB 3 at that resolution, the default first."""
    return (30, 15, 5) if (width, height) == (1280, 720) else (30, 15, 60, 90, 5)  # librealsense #11044


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class D405Calibration:
    """Optics of one unit at its full sensor width of 1280 pixels; other resolutions scale and crop it."""

    depth_focal_px: float = 641.52
    """Focal length of both rectified imagers [px] (realsense-ros user data, 425.008 at 848×480)."""
    depth_centre_px: tuple[float, float] = (646.99, 362.58)
    """Principal point of the same at 1280×720."""
    colour_focal_px: tuple[float, float] = (653.35, 652.77)
    """Focal lengths of the unrectified left imager [px] (393.0305 and 392.6793 at 640×480)."""
    colour_centre_px: tuple[float, float] = (628.23, 361.56)
    """Principal point of the same at 1280×720."""
    colour_coeffs: tuple[float, float, float, float, float] = (-0.050604, 0.056276, 0.000795, 0.000941, -0.018168)
    """Its "inverse Brown-Conrady" distortion k1, k2, p1, p2, k3. Since librealsense 2.50 or so that model's projection
    is OpenCV's, from the pinhole to the distorted image."""
    R_colour_depth: np.ndarray = field(
        default_factory=lambda: np.array(
            [
                [0.9999948750, -0.0008018584, -0.0030995140],
                [0.0007981384, 0.9999989600, -0.0012012377],
                [0.0031004740, 0.0011987577, 0.9999944750],
            ]
        )
    )
    """(3, 3) from the rectified to the unrectified axes of the left imager; there is no translation."""

    def depth(self, width: int, height: int) -> Intrinsics:
        """Return the pinhole of depth and infrared at that resolution."""
        scale = 0.6 if _is_vga(width, height) else width / 1280  # real units' focal lengths have this ratio
        return _scaled(width, height, scale, (self.depth_focal_px, self.depth_focal_px), self.depth_centre_px)

    def colour(self, width: int, height: int) -> Intrinsics:
        """Return focal lengths and principal point of the colour stream, to which `colour_coeffs` belong."""
        # At 640×480 the image is cut from one of 770×480 (librealsense's d400-color.cpp).
        scale = 770 / 1280 if _is_vga(width, height) else width / 1280
        return _scaled(width, height, scale, self.colour_focal_px, self.colour_centre_px)


def _is_vga(width: int, height: int) -> bool:
    return (width, height) == (640, 480)


def _scaled(
    width: int, height: int, scale: float, focal: tuple[float, float], centre: tuple[float, float]
) -> Intrinsics:
    return Intrinsics(
        width=width,
        height=height,
        fx=scale * focal[0],
        fy=scale * focal[1],
        # Other sizes are scaled and cropped about the middle of 1280×720, (640, 360).
        cx=width / 2 + scale * (centre[0] - 640),
        cy=height / 2 + scale * (centre[1] - 360),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureRequest:
    """Images requested of one exposure."""

    number: int
    """Number of the frame, which increases while streaming."""
    width: int
    """Width of every image [px]."""
    height: int
    """Height of every image [px]."""
    depth: bool = False
    colour: bool = False
    left: bool = False
    """Rectified image of the left imager."""
    right: bool = False
    """Rectified image of the right imager."""
    brightness: float = 1.0
    """Exposure time × gain, relative to auto-exposure's."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Exposure:
    """Images of one instant; None where not delivered."""

    number: int
    """Number of the `CaptureRequest`; a source that hangs repeats the last one."""
    stamp_s: float
    """Mid-exposure, by the source's clock [s]."""
    depth: np.ndarray | None = None
    """(H, W) uint16 distance along the optical axis in `DEPTH_UNIT_M`, rectified; 0 = no measurement."""
    colour: np.ndarray | None = None
    """(H, W, 3) uint8 RGB, unrectified."""
    left: np.ndarray | None = None
    """(H, W, 3) uint8 RGB, rectified."""
    right: np.ndarray | None = None
    """(H, W, 3) uint8 RGB, rectified."""


class FrameSource(Protocol):
    """The source of frames of a D405 that is not connected, for `hal.compat.realsense.plug`; used by one thread at a
    time."""

    @property
    def clock(self) -> Clock:
        """Clock of the frames' time stamps."""
        ...

    @property
    def lockstep(self) -> bool:
        """True: an exposure is made when a thread waits for it; False: by a thread, at the stream's rate."""
        ...

    @property
    def calibration(self) -> D405Calibration:
        """Calibration of the optics."""
        ...

    @property
    def attached(self) -> bool:
        """False while the cable is out."""
        ...

    def expose(self, request: CaptureRequest) -> Exposure | None:
        """Return the images of this moment; None = the camera hangs and delivers nothing."""
        ...

    def reset(self) -> None:
        """Reset the hardware, which ends a hang."""
        ...

    def close(self) -> None:
        """Free the resources that the next `expose` opens again."""
        ...
