"""One run of a D405's streams: found on the bus, set up, started, and each frame checked and aligned."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from hal.base import d405
from hal.base.errors import CameraError, InvalidValueError
from hal.base.messages import Intrinsics

logger = logging.getLogger(__name__)

_GRID_PX = 8
_ALIGNED_AT_M = 0.3
_USB_DEVICES = Path("/sys/bus/usb/devices")


@dataclass(frozen=True, slots=True, kw_only=True)
class D405CameraConfig:
    """How to use a D405.

    Raises:
        ValueError: the D405 has no such stream; the message says which it has.
    """

    serial: str = ""
    """Which one; empty = the only one there is."""
    width: int = 640
    """Of both images [px]; a D405 streams all its images at one size."""
    height: int = 480
    """Of both images [px]."""
    rate_hz: int = 30
    """Frames a second."""
    colour: Literal["colour", "infrared"] = "colour"
    """`colour` is the raw picture of the left imager, undistorted here; `infrared` the one that the camera has
    rectified itself, with the depth's own pixels but without white balance."""
    exposure_us: int | None = None
    """Exposure time [µs]; None = automatic."""
    gain: int | None = None
    """Gain; None = automatic, or the default with a given exposure time."""
    warm_up_s: float = 1.0
    """So long frames are thrown away, until exposure and time stamps have settled [s]."""
    search_s: float = 2.0
    """So long the camera is looked for when connecting [s]."""
    connect_timeout_s: float = 10.0
    """So long it is tried, with restarts and resets, until its first frame [s]."""
    silence_s: float = 1.0
    """After so long without a frame the next thing is tried [s]."""
    max_age_s: float = 0.5
    """Older frames are thrown away [s]."""

    def __post_init__(self) -> None:
        sizes = ", ".join(f"{w}×{h}" for w, h in d405.MIN_Z_M)
        if (self.width, self.height) not in d405.MIN_Z_M:
            raise InvalidValueError(f"a D405 has no stream of {self.width}×{self.height}; choose one of: {sizes}.")
        rates = d405.rates_hz(self.width, self.height)
        if self.rate_hz not in rates:
            allowed = ", ".join(map(str, sorted(rates)))
            raise InvalidValueError(f"rate_hz is {self.rate_hz}; at {self.width}×{self.height} a D405 has: {allowed}.")
        if self.colour not in ("colour", "infrared"):
            raise InvalidValueError(f"colour is {self.colour!r}; choose one of: colour, infrared.")
        for name, limits in (("exposure_us", d405.EXPOSURE_US), ("gain", d405.GAIN)):
            value = getattr(self, name)
            if value is not None and not limits[0] <= value <= limits[1]:
                raise InvalidValueError(f"{name} is {value}; a D405 takes {limits[0]} to {limits[1]}.")
        for name in ("warm_up_s", "search_s", "connect_timeout_s", "silence_s", "max_age_s"):
            if not 0 <= getattr(self, name) < 1e4:
                raise InvalidValueError(f"{name} is {getattr(self, name)} s; it must not be negative.")


def find_device(rs: Any, serial: str) -> Any | None:
    """Return the D405 with that serial number, or the only one; None when it is not on the bus.

    Raises:
        CameraError: there are several and none was chosen.
    """
    found = [device for device in rs.context().query_devices() if _info(rs, device, "name").endswith("D405")]
    if serial:
        found = [device for device in found if _info(rs, device, "serial_number") == serial]
    elif len(found) > 1:
        serials = ", ".join(_info(rs, device, "serial_number") for device in found)
        raise CameraError(f"there are {len(found)} D405s: {serials}; choose one by its serial number.")
    return found[0] if found else None


def why_not_found(rs: Any, serial: str, usb_devices: Path = _USB_DEVICES) -> str:
    """Return what was looked for, what is there instead, and what to do."""
    others = [
        f"{_info(rs, device, 'name')} {_info(rs, device, 'serial_number')}" for device in rs.context().query_devices()
    ]
    which = f"with serial number {serial} " if serial else ""
    looked = f"librealsense {rs.__version__} looked on USB for a D405 ({d405.USB_VENDOR}:{d405.USB_PRODUCT}) {which}"
    looked += f"and found {', '.join(others) if others else 'no RealSense camera'}."
    speeds = _usb_speeds(usb_devices)
    if speeds and not others:
        return (
            f"{looked} The kernel does see one, at {speeds[0]} Mbit/s: install librealsense's udev rules "
            "(99-realsense-libusb.rules to /etc/udev/rules.d, then `sudo udevadm control --reload && sudo udevadm "
            "trigger`), and end any other program that uses the camera."
        )
    return (
        f"{looked} Plug it into a USB 3 port with the cable it came with, try another port, and see what "
        f"`lsusb -d {d405.USB_VENDOR}:` says; without a camera, use the twin (`--sim`)."
    )


def _usb_speeds(usb_devices: Path) -> list[str]:
    """Return the bus speeds [Mbit/s] of the D405s that the kernel sees."""
    wanted = [d405.USB_VENDOR, d405.USB_PRODUCT.lower()]
    return [
        _text(path.parent / "speed") or "unknown"
        for path in usb_devices.glob("*/idProduct")
        if [_text(path.parent / "idVendor"), _text(path)] == wanted
    ]


def _text(path: Path) -> str:
    return path.read_text().strip() if path.is_file() else ""


def _info(rs: Any, device: Any, name: str) -> str:
    key = getattr(rs.camera_info, name)
    return device.get_info(key) if device.supports(key) else ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawFrame:
    """One frame set of the device, checked to be one."""

    number: int
    """The device's count."""
    device_s: float
    """The device's time [s]."""
    depth: Any
    """librealsense's frames, whose memory they keep."""
    colour: Any


class D405Session:
    """Streams of one device, started; made anew after everything that went wrong.

    Args:
        rs: `hal.compat.realsense`.
        device: from `find_device`.
        config: what to stream.

    Raises:
        CameraError: it will not stream that, or reports something that no D405 can mean.
    """

    def __init__(self, rs: Any, device: Any, config: D405CameraConfig) -> None:
        self._rs, self.device, self._config = rs, device, config
        self.serial = _info(rs, device, "serial_number")
        self._usb = _info(rs, device, "usb_type_descriptor")
        if self._usb.startswith("2"):
            logger.warning("the D405 %s runs over USB %s; USB 3 gives it all its streams", self.serial, self._usb)
        self._sensor = device.first_depth_sensor()
        self.set_exposure(config.exposure_us, config.gain)
        # One place: only the newest frame set is of use. A queue, since a pipeline's own wait would try for 15 s to
        # find a camera that was unplugged.
        self._queue = rs.frame_queue(1)
        self._pipeline = rs.pipeline()
        profile = self._start()
        try:
            self._read_optics(profile)
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """End the streams; a device that is gone may not answer any more."""
        try:
            self._pipeline.stop()
        except RuntimeError as error:
            logger.info("the D405 %s did not stop in order: %s", self.serial, error)

    def set_exposure(self, exposure_us: int | None, gain: int | None) -> None:
        """Set exposure time [µs] and gain, on the stereo module since a D405 has no other; None, None = automatic."""
        option = self._rs.option
        automatic = exposure_us is None and gain is None
        values = {option.global_time_enabled: 1.0, option.enable_auto_exposure: float(automatic)}
        if not automatic:
            values[option.exposure] = float(d405.EXPOSURE_US[-1] if exposure_us is None else exposure_us)
            values[option.gain] = float(d405.GAIN[-1] if gain is None else gain)
        for key, value in values.items():
            if self._sensor.supports(key):
                self._sensor.set_option(key, value)

    def wait(self, timeout_s: float) -> RawFrame | None:
        """Return the next frame set; None if none comes within `timeout_s` [s], or colour and depth are not one's."""
        came, frame = self._queue.try_wait_for_frame(max(1, round(1e3 * timeout_s)))
        frames = frame.as_frameset() if came else None
        if not frames:
            return None
        depth, colour = frames.get_depth_frame(), frames.get_color_frame()
        if not depth or not colour:
            return None
        return RawFrame(
            number=depth.get_frame_number(), device_s=1e-3 * depth.get_timestamp(), depth=depth, colour=colour
        )

    def is_torn(self, frame: RawFrame) -> bool:
        """True when colour is not of the same instant as depth: when it stalls, the last picture is repeated."""
        apart_s = abs(1e-3 * frame.colour.get_timestamp() - frame.device_s)
        return apart_s > 0.5 / self._config.rate_hz

    def images(self, frame: RawFrame) -> tuple[np.ndarray, np.ndarray]:
        """Return colour (H, W, 3) uint8 and depth (H, W) float32 [m], both seen through `intrinsics`."""
        depth_m = np.multiply(np.asanyarray(frame.depth.get_data()), self.depth_scale, dtype=np.float32)
        colour = np.asanyarray(frame.colour.get_data())
        if self._maps is not None:
            colour = cv2.remap(colour, *self._maps, cv2.INTER_LINEAR)
        return colour, depth_m

    def _start(self) -> Any:
        rs, c = self._rs, self._config
        wish = rs.config()
        wish.enable_device(self.serial)
        wish.enable_stream(rs.stream.depth, c.width, c.height, rs.format.z16, c.rate_hz)
        if c.colour == "colour":
            wish.enable_stream(rs.stream.color, c.width, c.height, rs.format.rgb8, c.rate_hz)
        else:
            wish.enable_stream(rs.stream.infrared, 0, c.width, c.height, rs.format.rgb8, c.rate_hz)
        try:
            return self._pipeline.start(wish, self._queue)
        except RuntimeError as error:
            raise CameraError(
                f"the D405 {self.serial} does not stream {c.width}×{c.height} at {c.rate_hz} Hz: {error}. It is on "
                f"USB {self._usb or 'of unknown speed'}; USB 2 allows 640×480 at 15 Hz. End any other program that "
                "uses it."
            ) from error

    def _read_optics(self, profile: Any) -> None:
        rs = self._rs
        depth = profile.get_stream(rs.stream.depth).as_video_stream_profile()
        optics = depth.get_intrinsics()
        self.depth_scale = self._sensor.get_depth_scale()
        if not 0.0 < self.depth_scale < 0.01:
            raise CameraError(f"the D405 {self.serial} gives its depth in units of {self.depth_scale} m; reset it.")
        if any(optics.coeffs):
            raise CameraError(f"the D405 {self.serial} gives a depth image with distortion {optics.coeffs}; reset it.")
        self.intrinsics = Intrinsics(
            width=optics.width, height=optics.height, fx=optics.fx, fy=optics.fy, cx=optics.ppx, cy=optics.ppy
        )
        self._maps = None
        if self._config.colour == "colour":
            colour = profile.get_stream(rs.stream.color).as_video_stream_profile()
            self._maps = alignment_maps(rs, self.intrinsics, colour.get_intrinsics(), depth.get_extrinsics_to(colour))


def alignment_maps(rs: Any, depth: Intrinsics, colour: Any, extrinsics: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return for every depth pixel the column and row (H, W) float32 of the colour image that shows the same.

    Colour and depth of a D405 come from one imager, so the same map holds at every distance, and depth keeps its
    pixels and its holes. `rs.align` is not used: on x86 it ignores colour's distortion, which is 5 px at the edge. The
    projection is librealsense's own, on a grid with steps of 8 px and linear between (0.01 px).

    Args:
        rs: `hal.compat.realsense`.
        depth: the pinhole of the depth image.
        colour: librealsense's intrinsics of the colour image.
        extrinsics: librealsense's, from depth to colour.
    """
    shift = np.linalg.norm(extrinsics.translation) * colour.fx / d405.MIN_Z_M[depth.width, depth.height]
    if shift > 1.0:  # no D405; then the map holds at one distance only
        logger.warning("colour and depth are not of one imager: colour is up to %.1f px off near the camera", shift)
    columns = np.arange(0, depth.width + _GRID_PX, _GRID_PX)
    rows = np.arange(0, depth.height + _GRID_PX, _GRID_PX)
    grid = np.empty((2, len(rows), len(columns)))
    for j, row in enumerate(rows):
        for i, column in enumerate(columns):
            ray = [(column - depth.cx) / depth.fx, (row - depth.cy) / depth.fy, 1.0]
            point = rs.rs2_transform_point_to_point(extrinsics, [_ALIGNED_AT_M * x for x in ray])
            grid[:, j, i] = rs.rs2_project_point_to_pixel(colour, point)
    pixels = np.mgrid[0 : depth.height, 0 : depth.width] / _GRID_PX
    u, v = (map_coordinates(nodes, pixels, order=1).astype(np.float32) for nodes in grid)
    return u, v
