"""Description of a twin D405 for librealsense: identity, options, profiles, optics."""

from __future__ import annotations

import cv2
import numpy as np

from hal.base import d405
from hal.base.d405 import D405Calibration
from hal.base.messages import Intrinsics
from hal.compat.realsense.library import native as rs

_COLOUR_FORMATS = {
    rs.format.rgb8: (3, None),
    rs.format.bgr8: (3, cv2.COLOR_RGB2BGR),
    rs.format.rgba8: (4, cv2.COLOR_RGB2RGBA),
    rs.format.bgra8: (4, cv2.COLOR_RGB2BGRA),
}
FORMATS = {
    (rs.stream.depth, 0): {rs.format.z16: (2, None)},
    (rs.stream.color, 0): {**_COLOUR_FORMATS, rs.format.yuyv: (2, cv2.COLOR_RGB2YUV_YUY2)},
    (rs.stream.infrared, 1): {rs.format.y8: (1, cv2.COLOR_RGB2GRAY)},
    (rs.stream.infrared, 2): {rs.format.y8: (1, cv2.COLOR_RGB2GRAY)},
    (rs.stream.infrared, 0): {**_COLOUR_FORMATS, rs.format.uyvy: (2, cv2.COLOR_RGB2YUV_UYVY)},
}
"""(stream, index) to format to (bytes a pixel, OpenCV's conversion from RGB)."""

# Source: librealsense's rs405_device.
_DEFAULTS = {
    (848, 480, 30, rs.stream.depth, rs.format.z16),
    (848, 480, 30, rs.stream.color, rs.format.rgb8),
}
"""Default profiles."""

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
"""Minimum, maximum, default, step. Exposure, gain and auto-exposure change the twin's images; the rest are stored."""


def add_sensor(handle, serial: str, calibration: D405Calibration):
    """Add the identity and the sensor of a D405 to a `software_device`; return the sensor."""
    sensor = handle.add_sensor(d405.SENSOR)
    _register_identity(handle, serial)
    _add_options(sensor)
    _add_profiles(sensor, calibration)
    handle.create_matcher(rs.matchers.default)  # as librealsense's rs405_device does
    return sensor


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
        info.usb_type_descriptor: "3.2",  # as real units report at a USB 3 port
        info.camera_locked: "YES",
    }.items():
        handle.register_info(key, value)


def _add_options(sensor) -> None:
    for option, (minimum, maximum, default, step) in _OPTIONS.items():
        limits = rs.option_range()  # its constructor swaps step and default
        limits.min, limits.max, limits.step, limits.default = minimum, maximum, step, default
        sensor.add_option(option, limits, True)
    sensor.add_read_only_option(rs.option.asic_temperature, d405.ASIC_C)
    sensor.add_read_only_option(rs.option.depth_units, d405.DEPTH_UNIT_M)
    sensor.add_read_only_option(rs.option.stereo_baseline, 1e3 * d405.BASELINE_M)  # librealsense: in millimetres


def _add_profiles(sensor, calibration: D405Calibration) -> None:
    """Add every profile of the D405; an incomplete request gets the first that fits."""
    added: dict[tuple, list] = {key: [] for key in FORMATS}
    for width, height in d405.MIN_Z_M:
        rectified = _optics(calibration.depth(width, height), rs.distortion.brown_conrady, (0.0,) * 5)
        raw = calibration.colour(width, height), calibration.colour_coeffs
        unrectified = _optics(raw[0], rs.distortion.inverse_brown_conrady, raw[1])
        for rate_hz in d405.rates_hz(width, height):
            for uid, ((stream, index), formats) in enumerate(FORMATS.items(), start=1):
                for format_, (bytes_per_pixel, _) in formats.items():
                    video = rs.video_stream()
                    video.type, video.index, video.uid, video.fmt = stream, index, uid, format_
                    video.width, video.height, video.fps, video.bpp = width, height, rate_hz, bytes_per_pixel
                    video.intrinsics = unrectified if stream == rs.stream.color else rectified
                    is_default = (width, height, rate_hz, stream, format_) in _DEFAULTS
                    added[stream, index].append(sensor.add_video_stream(video, is_default))
    _register_extrinsics(added, calibration)


def _optics(pinhole: Intrinsics, model, coeffs: tuple[float, ...]):
    optics = rs.intrinsics()
    optics.width, optics.height = pinhole.width, pinhole.height
    optics.fx, optics.fy, optics.ppx, optics.ppy = pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy
    optics.model, optics.coeffs = model, list(coeffs)
    return optics


def _register_extrinsics(added: dict[tuple, list], calibration: D405Calibration) -> None:
    first = added[rs.stream.depth, 0][0]
    for (stream, index), profiles in added.items():
        pose = rs.extrinsics()  # of the depth axes in the stream's
        rotation = calibration.R_colour_depth if stream == rs.stream.color else np.eye(3)
        pose.rotation = rotation.ravel(order="F").tolist()  # librealsense's matrices are column-major
        pose.translation = [-d405.BASELINE_M if index == 2 else 0.0, 0.0, 0.0]
        for profile in profiles:
            if profile is not first:
                first.register_extrinsics_to(profile, pose)
