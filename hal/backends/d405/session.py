"""One streaming session of a D405: search on the bus, configuration, start, frame validation and alignment."""

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

_GRID_PX = 8  # 0.01 px from the exact map, see `alignment_maps`
_ALIGNED_AT_M = 0.3  # any distance gives the same map, as colour and depth share one imager
_USB_DEVICES = Path("/sys/bus/usb/devices")


@dataclass(frozen=True, slots=True, kw_only=True)
class D405CameraConfig:
    """Streams, exposure and timeouts of a D405.

    Raises:
        InvalidValueError: the D405 has no such stream; the message lists those it has.
    """

    serial: str = ""
    """Serial number; empty = the only D405 on the bus."""
    width: int = 640
    """Width of both images [px]; a D405 streams all its images at one size."""
    height: int = 480
    """Height of both images [px]."""
    rate_hz: int = 30
    """Frames a second."""
    colour: Literal["colour", "infrared"] = "colour"
    """`colour` is the raw image of the left imager, undistorted here; `infrared` the one that the camera rectifies
    itself, with the depth's own pixels but without white balance."""
    exposure_us: int | None = None
    """Exposure time [µs]; None = automatic."""
    gain: int | None = None
    """Gain; None = automatic, or the default with a given exposure time."""
    warm_up_s: float = 1.0
    """Frames of this duration are discarded, until exposure and time stamps have settled [s]."""
    search_s: float = 2.0
    """Search time on the bus when connecting [s]."""
    connect_timeout_s: float = 10.0
    """Timeout of the first frame, restarts and resets included [s]."""
    silence_s: float = 1.0
    """Duration without a frame until the next recovery step [s]."""
    max_age_s: float = 0.5
    """Maximum age of a frame [s]."""

    def __post_init__(self) -> None:
        sizes = ", ".join(f"{w}×{h}" for w, h in d405.MIN_Z_M)
        if (self.width, self.height) not in d405.MIN_Z_M:
            raise InvalidValueError(
                f"D405: there is no stream of {self.width}×{self.height}; allowed are: {sizes}.", code="resolution"
            )
        rates = d405.rates_hz(self.width, self.height)
        if self.rate_hz not in rates:
            allowed = ", ".join(map(str, sorted(rates)))
            raise InvalidValueError(
                f"D405: rate_hz is {self.rate_hz}; allowed at {self.width}×{self.height} are: {allowed}.", code="rate"
            )
        if self.colour not in ("colour", "infrared"):
            raise InvalidValueError(
                f"D405: colour is {self.colour!r}; allowed are: colour, infrared.", code="colour_stream"
            )
        for name, limits in (("exposure_us", d405.EXPOSURE_US), ("gain", d405.GAIN)):
            value = getattr(self, name)
            if value is not None and not limits[0] <= value <= limits[1]:
                raise InvalidValueError(
                    f"D405: {name} is {value}; allowed is {limits[0]} to {limits[1]}.", code="exposure"
                )
        for name in ("warm_up_s", "search_s", "connect_timeout_s", "silence_s", "max_age_s"):
            if not 0 <= getattr(self, name) < 1e4:
                raise InvalidValueError(
                    f"D405: {name} is {getattr(self, name)} s; allowed is 0 to 10000 s.", code="duration"
                )


def find_device(rs: Any, serial: str) -> Any | None:
    """Return the D405 with that serial number, or the only one; None when it is not on the bus.

    Raises:
        CameraError: several D405s, and no serial number.
    """
    found = [device for device in rs.context().query_devices() if _info(rs, device, "name").endswith("D405")]
    if serial:
        found = [device for device in found if _info(rs, device, "serial_number") == serial]
    elif len(found) > 1:
        serials = ", ".join(_info(rs, device, "serial_number") for device in found)
        raise CameraError(
            f"D405: {len(found)} cameras are connected: {serials}; choose one by its serial number.",
            code="ambiguous_camera",
        )
    return found[0] if found else None


def describe_missing(rs: Any, serial: str, usb_devices: Path = _USB_DEVICES) -> str:
    """Return the text of a failed search: the criteria, the cameras found, and the remedy."""
    others = [
        f"{_info(rs, device, 'name')} {_info(rs, device, 'serial_number')}" for device in rs.context().query_devices()
    ]
    which = f"with serial number {serial} " if serial else ""
    search = f"librealsense {rs.__version__} searched USB for a D405 ({d405.USB_VENDOR}:{d405.USB_PRODUCT}) {which}"
    search += f"and found {', '.join(others) if others else 'no RealSense camera'}."
    speeds = _usb_speeds(usb_devices)
    if speeds and not others:
        return (
            f"{search} The kernel lists one, at {speeds[0]} Mbit/s: install librealsense's udev rules "
            "(99-realsense-libusb.rules to /etc/udev/rules.d, then `sudo udevadm control --reload && sudo udevadm "
            "trigger`), and end any other program that uses the camera."
        )
    return (
        f"{search} Plug it into a USB 3 port with the cable it came with, try another port, and check "
        f"`lsusb -d {d405.USB_VENDOR}:`; without a camera, use the twin (`--sim`)."
    )


def _usb_speeds(usb_devices: Path) -> list[str]:
    """Return the bus speeds [Mbit/s] of the D405s that the kernel lists."""
    vendor_product = [d405.USB_VENDOR, d405.USB_PRODUCT.lower()]
    return [
        _text(path.parent / "speed") or "unknown"
        for path in usb_devices.glob("*/idProduct")
        if [_text(path.parent / "idVendor"), _text(path)] == vendor_product
    ]


def _text(path: Path) -> str:
    return path.read_text().strip() if path.is_file() else ""


def _info(rs: Any, device: Any, name: str) -> str:
    key = getattr(rs.camera_info, name)
    return device.get_info(key) if device.supports(key) else ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawFrame:
    """One complete frame set of the device."""

    number: int
    """Frame number of the device."""
    device_s: float
    """Time stamp of the device [s]."""
    depth: Any
    """librealsense's frames; they own the memory of the images."""
    colour: Any


class D405Session:
    """Running streams of one device; a failed session is replaced by a new one.

    Args:
        rs: `hal.compat.realsense`.
        device: from `find_device`.
        config: streams and exposure.

    Raises:
        CameraError: the device rejects the streams, or reports optics that no D405 has.
    """

    def __init__(self, rs: Any, device: Any, config: D405CameraConfig) -> None:
        self._rs, self.device, self._config = rs, device, config
        self.serial = _info(rs, device, "serial_number")
        self._usb = _info(rs, device, "usb_type_descriptor")
        if self._usb.startswith("2"):
            logger.warning("D405 %s: connected over USB %s; all its streams need USB 3", self.serial, self._usb)
        self._sensor = device.first_depth_sensor()
        self.set_exposure(config.exposure_us, config.gain)
        # Capacity 1: only the newest frame set is used. A queue, since the pipeline's own wait searches for an
        # unplugged camera for 15 s.
        self._queue = rs.frame_queue(1)
        self._pipeline = rs.pipeline()
        profile = self._start()
        try:
            self._read_optics(profile)
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Stop the streams; a device that has left the bus may not answer."""
        try:
            self._pipeline.stop()
        except RuntimeError as error:
            logger.info("D405 %s: the streams did not stop in order: %s", self.serial, error)

    def set_exposure(self, exposure_us: int | None, gain: int | None) -> None:
        """Set exposure time [µs] and gain, on the stereo module, the D405's only sensor; None, None = automatic."""
        option = self._rs.option
        automatic = exposure_us is None and gain is None
        # Global time: stamps in Unix time, which `StampConverter` expects.
        values = {option.global_time_enabled: 1.0, option.enable_auto_exposure: float(automatic)}
        if not automatic:
            values[option.exposure] = float(d405.EXPOSURE_US[-1] if exposure_us is None else exposure_us)
            values[option.gain] = float(d405.GAIN[-1] if gain is None else gain)
        for key, value in values.items():
            if self._sensor.supports(key):
                self._sensor.set_option(key, value)

    def wait(self, timeout_s: float) -> RawFrame | None:
        """Return the next frame set; None without one within `timeout_s` [s], or without both images."""
        received, frame = self._queue.try_wait_for_frame(max(1, round(1e3 * timeout_s)))
        frames = frame.as_frameset() if received else None
        if not frames:
            return None
        depth, colour = frames.get_depth_frame(), frames.get_color_frame()
        if not depth or not colour:
            return None
        return RawFrame(
            number=depth.get_frame_number(), device_s=1e-3 * depth.get_timestamp(), depth=depth, colour=colour
        )

    def is_torn(self, frame: RawFrame) -> bool:
        """Return whether colour and depth are of different instants: a stalled colour stream repeats its last image."""
        interval_s = abs(1e-3 * frame.colour.get_timestamp() - frame.device_s)
        return interval_s > 0.5 / self._config.rate_hz  # images of one exposure are about 0.3 ms apart (field log)

    def images(self, frame: RawFrame) -> tuple[np.ndarray, np.ndarray]:
        """Return colour (H, W, 3) uint8 and depth (H, W) float32 [m], both with the pinhole `intrinsics`."""
        depth_m = np.multiply(np.asanyarray(frame.depth.get_data()), self.depth_scale, dtype=np.float32)
        colour = np.asanyarray(frame.colour.get_data())
        if self._maps is not None:
            colour = cv2.remap(colour, *self._maps, cv2.INTER_LINEAR)
        return colour, depth_m

    def _start(self) -> Any:
        rs, c = self._rs, self._config
        request = rs.config()
        request.enable_device(self.serial)
        request.enable_stream(rs.stream.depth, c.width, c.height, rs.format.z16, c.rate_hz)
        if c.colour == "colour":
            request.enable_stream(rs.stream.color, c.width, c.height, rs.format.rgb8, c.rate_hz)
        else:
            # Index 0: the rectified left imager in colour; 1 and 2 are both imagers in grey.
            request.enable_stream(rs.stream.infrared, 0, c.width, c.height, rs.format.rgb8, c.rate_hz)
        try:
            return self._pipeline.start(request, self._queue)
        except RuntimeError as error:
            raise CameraError(
                f"D405 {self.serial}: no stream of {c.width}×{c.height} at {c.rate_hz} Hz: {error}. It is on USB "
                f"{self._usb or 'of unknown speed'}; USB 2 allows 640×480 at 15 Hz. End any other program using it.",
                code="stream_rejected",
            ) from error

    def _read_optics(self, profile: Any) -> None:
        rs = self._rs
        depth = profile.get_stream(rs.stream.depth).as_video_stream_profile()
        optics = depth.get_intrinsics()
        self.depth_scale = self._sensor.get_depth_scale()
        if not 0.0 < self.depth_scale < 0.01:  # up to 100 times the unit of a new device, 0.1 mm
            raise CameraError(
                f"D405 {self.serial}: the depth unit is {self.depth_scale} m; allowed is 0 to 0.01 m. Reset it.",
                code="invalid_optics",
            )
        if any(optics.coeffs):
            raise CameraError(
                f"D405 {self.serial}: the depth image has distortion {optics.coeffs}; allowed is none. Reset it.",
                code="invalid_optics",
            )
        self.intrinsics = Intrinsics(
            width=optics.width, height=optics.height, fx=optics.fx, fy=optics.fy, cx=optics.ppx, cy=optics.ppy
        )
        self._maps = None
        if self._config.colour == "colour":
            colour = profile.get_stream(rs.stream.color).as_video_stream_profile()
            self._maps = alignment_maps(rs, self.intrinsics, colour.get_intrinsics(), depth.get_extrinsics_to(colour))


def alignment_maps(rs: Any, depth: Intrinsics, colour: Any, extrinsics: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the column and row (H, W) float32 in the colour image of every depth pixel.

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
        logger.warning("D405: colour and depth are of two imagers: colour is up to %.1f px off near the camera", shift)
    columns = np.arange(0, depth.width + _GRID_PX, _GRID_PX)
    rows = np.arange(0, depth.height + _GRID_PX, _GRID_PX)
    grid = np.empty((2, len(rows), len(columns)))
    for j, row in enumerate(rows):
        for i, column in enumerate(columns):
            ray = _ALIGNED_AT_M * depth.deproject(np.array([column]), np.array([row]), np.ones(1))[0]
            point = rs.rs2_transform_point_to_point(extrinsics, ray.tolist())
            grid[:, j, i] = rs.rs2_project_point_to_pixel(colour, point)
    pixels = np.mgrid[0 : depth.height, 0 : depth.width] / _GRID_PX
    u, v = (map_coordinates(nodes, pixels, order=1).astype(np.float32) for nodes in grid)
    return u, v
