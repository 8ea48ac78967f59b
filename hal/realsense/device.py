"""A D405 for librealsense whose frames come from a `FrameSource`: one `software_device` with everything on it."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable

import cv2
import numpy as np

from hal import d405
from hal.clock import unix_offset_s
from hal.d405 import Calibration, Exposure, FrameSource, Look
from hal.messages import Intrinsics
from hal.realsense.library import native as rs

logger = logging.getLogger(__name__)

SERIAL = "000000000405"
"""Of a twin, unless told otherwise: of the right length, and no real unit's."""
_IDLE_S = 1.0 / 30.0

_PICTURES = {
    rs.format.rgb8: (3, None),
    rs.format.bgr8: (3, cv2.COLOR_RGB2BGR),
    rs.format.rgba8: (4, cv2.COLOR_RGB2RGBA),
    rs.format.bgra8: (4, cv2.COLOR_RGB2BGRA),
}
_FORMATS = {
    (rs.stream.depth, 0): {rs.format.z16: (2, None)},
    (rs.stream.color, 0): {**_PICTURES, rs.format.yuyv: (2, cv2.COLOR_RGB2YUV_YUY2)},
    (rs.stream.infrared, 1): {rs.format.y8: (1, cv2.COLOR_RGB2GRAY)},
    (rs.stream.infrared, 2): {rs.format.y8: (1, cv2.COLOR_RGB2GRAY)},
    (rs.stream.infrared, 0): {**_PICTURES, rs.format.uyvy: (2, cv2.COLOR_RGB2YUV_UYVY)},
}
"""(stream, index) to format to (bytes a pixel, OpenCV's conversion from RGB)."""

_DEFAULTS = {
    (848, 480, 30, rs.stream.depth, rs.format.z16),
    (848, 480, 30, rs.stream.color, rs.format.rgb8),
}
"""What streams when nothing is asked for."""

_OPTIONS = {
    rs.option.exposure: (*d405.EXPOSURE_US, 1),
    rs.option.gain: (*d405.GAIN, 1),
    rs.option.enable_auto_exposure: (0, 1, 1, 1),
    rs.option.brightness: (-64, 64, 0, 1),
    rs.option.contrast: (0, 100, 50, 1),
    rs.option.saturation: (0, 100, 64, 1),
    rs.option.sharpness: (0, 100, 50, 1),
    rs.option.gamma: (100, 500, 300, 1),
    rs.option.hue: (-180, 180, 0, 1),
    rs.option.white_balance: (2800, 6500, 4600, 10),
    rs.option.enable_auto_white_balance: (0, 1, 1, 1),
    rs.option.backlight_compensation: (0, 1, 0, 1),
    rs.option.power_line_frequency: (0, 2, 2, 1),
    rs.option.visual_preset: (0, 6, 0, 1),
    rs.option.global_time_enabled: (0, 1, 1, 1),
}
"""Lowest, highest, default, step. Exposure, gain and auto-exposure change the twin's pictures; the rest are kept."""


class TwinDevice:
    """One twin on librealsense's side: its identity, profiles and options, and the way of a frame into the library.

    Args:
        source: the optics.
        serial: by which programs choose it.

    In free run a thread of its own makes the exposures; `start` begins and `close` ends it.
    """

    def __init__(self, source: FrameSource, serial: str = SERIAL) -> None:
        self.source, self.serial = source, serial
        self.handle = rs.software_device()
        self.lock = threading.RLock()
        """Held while frames go into the library; starting and stopping streams holds it too."""
        self.on_presence: Callable[[bool], None] = lambda present: None
        """Called when the device leaves or returns."""
        self._sensor = self.handle.add_sensor(d405.SENSOR)
        _register_identity(self.handle, serial)
        _add_options(self._sensor)
        _add_profiles(self._sensor, source)
        self.handle.create_matcher(rs.matchers.default)
        self._first_s: float | None = None
        self._streams: list[tuple] = []
        self._away_until_s = -math.inf
        self._was_present = True
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def present(self) -> bool:
        """False while the cable is out or a reset is under way, and once unplugged."""
        return not self._ended.is_set() and self.source.attached and self.source.clock.now_s() >= self._away_until_s

    def start(self) -> None:
        """Begin to deliver, unless frames are made only on demand."""
        if not self.source.lockstep and self._thread is None:
            self._thread = threading.Thread(target=self._run, name=f"twin D405 {self.serial}", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Deliver no more."""
        self._ended.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        self._thread = None

    def restart(self) -> None:
        """Streams were started: instants and frame numbers begin anew."""
        self._first_s = None

    def reset(self) -> None:
        """Do what `hardware_reset()` does: leave the bus for a while."""
        self._away_until_s = self.source.clock.now_s() + d405.RESET_S
        self.source.reset()
        self._tell_presence()

    def step(self, timeout_s: float) -> None:
        """Lock-step: let the clock run to the next instant, or for `timeout_s` [s] if that is nearer, and deliver."""
        clock = self.source.clock
        now_s = clock.now_s()
        number, due_s = self._next_instant(now_s)
        if due_s > now_s + timeout_s:
            clock.sleep_until(now_s + timeout_s)
        else:
            clock.sleep_until(due_s)
            self._deliver(number)
        self._tell_presence()

    def _run(self) -> None:
        clock = self.source.clock
        try:
            while not self._ended.is_set():
                number, due_s = self._next_instant(clock.now_s())
                clock.sleep_until(due_s)
                self._deliver(number)
                self._tell_presence()
        except Exception:
            logger.exception("the optics of the twin %s failed; it has left the bus", self.serial)
            self._ended.set()
            self._tell_presence()

    def _tell_presence(self) -> None:
        present = self.present
        if present != self._was_present:
            self._was_present = present
            self.on_presence(present)

    def _next_instant(self, now_s: float) -> tuple[int, float]:
        """Return number and time [s] of the next frame; without streams, of the next look whether there are some."""
        profiles = self._active()
        streams = [_key(profile) for profile in profiles]
        if self._first_s is None or streams != self._streams:
            self._first_s, self._streams = now_s, streams
        if not streams:
            return 0, now_s + _IDLE_S
        rate_hz = streams[0][-1]
        # The tolerance keeps an instant that rounding puts a hair after its own step from being seen twice.
        number = math.floor((now_s - self._first_s) * rate_hz + 1e-6) + 1
        return number, self._first_s + number / rate_hz

    def _deliver(self, number: int) -> None:
        profiles = self._active()
        if not profiles or not self.present:
            return
        exposure = self.source.expose(self._look(number, profiles))
        if exposure is None:
            return
        with self.lock:
            active = {_key(profile) for profile in self._active()}
            for profile in profiles:
                if _key(profile) in active:  # else it was stopped while the picture was made
                    self._set_metadata(exposure)
                    self._inject(profile, exposure)

    def _active(self) -> list:
        return [profile.as_video_stream_profile() for profile in self._sensor.get_active_streams()]

    def _look(self, number: int, profiles: list) -> Look:
        wanted = {(p.stream_type(), p.stream_index()) for p in profiles}
        automatic = bool(self._sensor.get_option(rs.option.enable_auto_exposure))
        brightness = 1.0
        if not automatic:
            brightness = self._sensor.get_option(rs.option.exposure) / d405.EXPOSURE_US[-1]
            brightness *= self._sensor.get_option(rs.option.gain) / d405.GAIN[-1]
        return Look(
            number=number,
            width=profiles[0].width(),
            height=profiles[0].height(),
            depth=(rs.stream.depth, 0) in wanted,
            colour=(rs.stream.color, 0) in wanted,
            left=bool(wanted & {(rs.stream.infrared, 0), (rs.stream.infrared, 1)}),
            right=(rs.stream.infrared, 2) in wanted,
            brightness=brightness,
        )

    def _set_metadata(self, exposure: Exposure) -> None:
        offset_s = unix_offset_s(self.source.clock)
        value, sensor = rs.frame_metadata_value, self._sensor
        sensor.set_metadata(value.frame_counter, exposure.number)
        sensor.set_metadata(value.frame_timestamp, round(1e6 * exposure.stamp_s))
        sensor.set_metadata(value.sensor_timestamp, round(1e6 * exposure.stamp_s))
        arrival_ms = round(1e3 * (self.source.clock.now_s() + offset_s))
        sensor.set_metadata(value.time_of_arrival, arrival_ms)
        sensor.set_metadata(value.backend_timestamp, arrival_ms)
        sensor.set_metadata(value.actual_exposure, round(sensor.get_option(rs.option.exposure)))
        sensor.set_metadata(value.gain_level, round(sensor.get_option(rs.option.gain)))
        sensor.set_metadata(value.auto_exposure, round(sensor.get_option(rs.option.enable_auto_exposure)))

    def _inject(self, profile, exposure: Exposure) -> None:
        stream, index = profile.stream_type(), profile.stream_index()
        bytes_per_pixel, conversion = _FORMATS[stream, index][profile.format()]
        size = (profile.height(), profile.width())
        if stream == rs.stream.depth:
            name, shape, dtype = "depth", size, np.uint16
        else:
            name = "colour" if stream == rs.stream.color else "right" if index == 2 else "left"
            shape, dtype = (*size, 3), np.uint8
        image = getattr(exposure, name)
        if image is None:
            return
        image = _checked(image, shape, dtype, name)
        if conversion is not None:
            image = cv2.cvtColor(image, conversion)
        # A new one for every frame: the library owns what it was given, and giving it twice frees it twice.
        frame = rs.software_video_frame()
        frame.pixels = image
        frame.stride, frame.bpp = size[1] * bytes_per_pixel, bytes_per_pixel
        frame.timestamp = 1e3 * (exposure.stamp_s + unix_offset_s(self.source.clock))
        frame.domain = rs.timestamp_domain.global_time
        frame.frame_number = exposure.number
        frame.profile = profile
        if stream == rs.stream.depth:
            frame.depth_units = d405.DEPTH_UNIT_M
        self._sensor.on_video_frame(frame)


def _key(profile) -> tuple:
    size = (profile.width(), profile.height())
    return (profile.stream_type(), profile.stream_index(), profile.format(), *size, profile.fps())


def _checked(image: np.ndarray, shape: tuple[int, ...], dtype: type, name: str) -> np.ndarray:
    """Return the image in one piece; the library copies its bytes without looking at shape, type or strides."""
    if image.shape != shape or image.dtype != dtype:
        seen, wanted = f"{image.dtype} {image.shape}", f"{np.dtype(dtype).name} {shape}"
        raise ValueError(f"the frame source gave {seen} for {name}; wanted is {wanted}.")
    return np.ascontiguousarray(image)


def _register_identity(handle, serial: str) -> None:
    info = rs.camera_info
    for key, value in {
        info.name: d405.NAME,
        info.serial_number: serial,
        info.asic_serial_number: serial,
        info.firmware_update_id: serial,
        info.firmware_version: d405.FIRMWARE,
        info.recommended_firmware_version: d405.FIRMWARE,
        info.physical_port: f"twin/{serial}",
        info.product_id: d405.USB_PRODUCT,
        info.product_line: d405.PRODUCT_LINE,
        info.usb_type_descriptor: "3.2",
        info.camera_locked: "YES",
    }.items():
        handle.register_info(key, value)


def _add_options(sensor) -> None:
    for option, (lowest, highest, default, step) in _OPTIONS.items():
        limits = rs.option_range()  # its constructor takes step and default the wrong way round
        limits.min, limits.max, limits.step, limits.default = lowest, highest, step, default
        sensor.add_option(option, limits, True)
    sensor.add_read_only_option(rs.option.depth_units, d405.DEPTH_UNIT_M)
    sensor.add_read_only_option(rs.option.stereo_baseline, 1e3 * d405.BASELINE_M)  # librealsense: in millimetres


def _add_profiles(sensor, source: FrameSource) -> None:
    """Add every profile of the D405; a request that leaves something open takes the first that fits."""
    added: dict[tuple, list] = {key: [] for key in _FORMATS}
    for width, height in d405.MIN_Z_M:
        rectified = _optics(source.calibration.depth(width, height), rs.distortion.brown_conrady, (0.0,) * 5)
        raw = source.calibration.colour(width, height), source.calibration.colour_coeffs
        unrectified = _optics(raw[0], rs.distortion.inverse_brown_conrady, raw[1])
        for rate_hz in d405.rates_hz(width, height):
            for uid, ((stream, index), formats) in enumerate(_FORMATS.items(), start=1):
                for format_, (bytes_per_pixel, _) in formats.items():
                    video = rs.video_stream()
                    video.type, video.index, video.uid, video.fmt = stream, index, uid, format_
                    video.width, video.height, video.fps, video.bpp = width, height, rate_hz, bytes_per_pixel
                    video.intrinsics = unrectified if stream == rs.stream.color else rectified
                    is_default = (width, height, rate_hz, stream, format_) in _DEFAULTS
                    added[stream, index].append(sensor.add_video_stream(video, is_default))
    _register_extrinsics(added, source.calibration)


def _optics(pinhole: Intrinsics, model, coeffs: tuple[float, ...]):
    optics = rs.intrinsics()
    optics.width, optics.height = pinhole.width, pinhole.height
    optics.fx, optics.fy, optics.ppx, optics.ppy = pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy
    optics.model, optics.coeffs = model, list(coeffs)
    return optics


def _register_extrinsics(added: dict[tuple, list], calibration: Calibration) -> None:
    first = added[rs.stream.depth, 0][0]
    for (stream, index), profiles in added.items():
        pose = rs.extrinsics()  # of the depth axes seen from the stream's
        rotation = calibration.R_colour_depth if stream == rs.stream.color else np.eye(3)
        pose.rotation = rotation.ravel(order="F").tolist()
        pose.translation = [-d405.BASELINE_M if index == 2 else 0.0, 0.0, 0.0]
        for profile in profiles:
            if profile is not first:
                first.register_extrinsics_to(profile, pose)
