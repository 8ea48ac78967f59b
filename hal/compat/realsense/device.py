"""A D405 for librealsense with the frames of a `FrameSource`: one `software_device` with one sensor."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable

import cv2
import numpy as np

from hal.base import d405
from hal.base.clock import unix_offset_s
from hal.base.d405 import CaptureRequest, Exposure, FrameSource
from hal.compat.realsense.description import FORMATS, add_sensor
from hal.compat.realsense.library import native as rs

logger = logging.getLogger(__name__)

SERIAL = "000000000405"
"""Default serial number of a twin: of the right length, and of no real unit."""
_IDLE_S = 1.0 / 30.0  # between two checks for streams


class TwinDevice:
    """One twin on librealsense's side: identity, profiles, options, and the injection of its frames.

    In free run a thread of its own makes the exposures, from `start` to `close`.

    Args:
        source: the optics.
        serial: serial number.
    """

    def __init__(self, source: FrameSource, serial: str = SERIAL) -> None:
        self.source, self.serial = source, serial
        self.handle = rs.software_device()
        self.lock = threading.RLock()
        """Held during the injection of frames, and during the start and stop of streams."""
        self.on_presence: Callable[[bool], None] = lambda present: None
        """Called when the device leaves the bus or returns."""
        self._sensor = add_sensor(self.handle, serial, source.calibration)
        self._first_s: float | None = None
        self._streams: list[tuple] = []
        self._absent_until_s = -math.inf
        self._was_present = True
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def present(self) -> bool:
        """False while the cable is out or a reset is under way, and once unplugged."""
        return not self._ended.is_set() and self.source.attached and self.source.clock.now_s() >= self._absent_until_s

    def start(self) -> None:
        """Start the thread, unless frames are made on demand."""
        if not self.source.lockstep and self._thread is None:
            self._thread = threading.Thread(target=self._run, name=f"twin D405 {self.serial}", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """End the thread, and the device's presence on the bus."""
        self._ended.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        self._thread = None

    def restart(self) -> None:
        """Restart exposure times and frame numbers, at a start of streams."""
        self._first_s = None

    def reset(self) -> None:
        """Leave the bus for a while, as after `hardware_reset()`."""
        self._absent_until_s = self.source.clock.now_s() + d405.RESET_S
        self.source.reset()
        self._report_presence()

    def step(self, timeout_s: float) -> None:
        """Advance the clock in lock-step to the next exposure and deliver it, or by `timeout_s` [s] if that is less."""
        clock = self.source.clock
        now_s = clock.now_s()
        number, due_s = self._next_instant(now_s)
        if due_s > now_s + timeout_s:
            clock.sleep_until(now_s + timeout_s)
        else:
            clock.sleep_until(due_s)
            self._deliver(number)
        self._report_presence()

    def _run(self) -> None:
        clock = self.source.clock
        try:
            while not self._ended.is_set():
                number, due_s = self._next_instant(clock.now_s())
                clock.sleep_until(due_s)
                self._deliver(number)
                self._report_presence()
        except Exception:  # every type: a twin without its thread would seem to hang
            logger.exception("D405 twin %s: the optics failed; it has left the bus", self.serial)
            self._ended.set()
            self._report_presence()

    def _report_presence(self) -> None:
        present = self.present
        if present != self._was_present:
            self._was_present = present
            self.on_presence(present)

    def _next_instant(self, now_s: float) -> tuple[int, float]:
        """Return number and time [s] of the next frame; without streams, of the next check for streams."""
        profiles = self._active()
        streams = [_key(profile) for profile in profiles]
        if self._first_s is None or streams != self._streams:
            self._first_s, self._streams = now_s, streams
        if not streams:
            return 0, now_s + _IDLE_S
        rate_hz = streams[0][-1]
        # The tolerance avoids a repeated frame when rounding puts an instant just after its own step.
        number = math.floor((now_s - self._first_s) * rate_hz + 1e-6) + 1
        return number, self._first_s + number / rate_hz

    def _deliver(self, number: int) -> None:
        profiles = self._active()
        if not profiles or not self.present:
            return
        exposure = self.source.expose(self._make_request(number, profiles))
        if exposure is None:
            return
        with self.lock:
            active = {_key(profile) for profile in self._active()}
            for profile in profiles:
                if _key(profile) in active:  # else it was stopped during the exposure
                    self._set_metadata(exposure)
                    self._inject(profile, exposure)

    def _active(self) -> list:
        return [profile.as_video_stream_profile() for profile in self._sensor.get_active_streams()]

    def _make_request(self, number: int, profiles: list) -> CaptureRequest:
        streams = {(p.stream_type(), p.stream_index()) for p in profiles}
        automatic = bool(self._sensor.get_option(rs.option.enable_auto_exposure))
        brightness = 1.0
        if not automatic:
            brightness = self._sensor.get_option(rs.option.exposure) / d405.EXPOSURE_US[-1]
            brightness *= self._sensor.get_option(rs.option.gain) / d405.GAIN[-1]
        return CaptureRequest(
            number=number,
            width=profiles[0].width(),
            height=profiles[0].height(),
            depth=(rs.stream.depth, 0) in streams,
            colour=(rs.stream.color, 0) in streams,
            left=bool(streams & {(rs.stream.infrared, 0), (rs.stream.infrared, 1)}),
            right=(rs.stream.infrared, 2) in streams,
            brightness=brightness,
        )

    def _set_metadata(self, exposure: Exposure) -> None:
        offset_s = unix_offset_s(self.source.clock)
        value, sensor = rs.frame_metadata_value, self._sensor
        sensor.set_metadata(value.frame_counter, exposure.number)
        sensor.set_metadata(value.frame_timestamp, round(1e6 * exposure.stamp_s))  # librealsense: microseconds
        sensor.set_metadata(value.sensor_timestamp, round(1e6 * exposure.stamp_s))
        arrival_ms = round(1e3 * (self.source.clock.now_s() + offset_s))
        sensor.set_metadata(value.time_of_arrival, arrival_ms)
        sensor.set_metadata(value.backend_timestamp, arrival_ms)
        sensor.set_metadata(value.actual_exposure, round(sensor.get_option(rs.option.exposure)))
        sensor.set_metadata(value.gain_level, round(sensor.get_option(rs.option.gain)))
        sensor.set_metadata(value.auto_exposure, round(sensor.get_option(rs.option.enable_auto_exposure)))

    def _inject(self, profile, exposure: Exposure) -> None:
        stream, index = profile.stream_type(), profile.stream_index()
        bytes_per_pixel, conversion = FORMATS[stream, index][profile.format()]
        size = (profile.height(), profile.width())
        if stream == rs.stream.depth:
            name, shape, dtype = "depth", size, np.uint16
        else:
            name = "colour" if stream == rs.stream.color else "right" if index == 2 else "left"
            shape, dtype = (*size, 3), np.uint8
        image = getattr(exposure, name)
        if image is None:
            return
        image = _check_image(image, shape, dtype, name)
        if conversion is not None:
            image = cv2.cvtColor(image, conversion)
        # A new object for every frame: the library owns it, and frees an object that is passed twice twice.
        frame = rs.software_video_frame()
        frame.pixels = image
        frame.stride, frame.bpp = size[1] * bytes_per_pixel, bytes_per_pixel
        frame.timestamp = 1e3 * (exposure.stamp_s + unix_offset_s(self.source.clock))
        frame.domain = rs.timestamp_domain.global_time  # the default of a D400
        frame.frame_number = exposure.number
        frame.profile = profile
        if stream == rs.stream.depth:
            frame.depth_units = d405.DEPTH_UNIT_M
        self._sensor.on_video_frame(frame)


def _key(profile) -> tuple:
    size = (profile.width(), profile.height())
    return (profile.stream_type(), profile.stream_index(), profile.format(), *size, profile.fps())


def _check_image(image: np.ndarray, shape: tuple[int, ...], dtype: type, name: str) -> np.ndarray:
    """Return a contiguous image; the library copies its bytes without a check of shape, type or strides."""
    if image.shape != shape or image.dtype != dtype:
        allowed = f"{np.dtype(dtype).name} {shape}"
        raise ValueError(f"D405 twin: the {name} image is {image.dtype} {image.shape}; allowed is {allowed}.")
    return np.ascontiguousarray(image)
