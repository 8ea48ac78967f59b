"""The D405's driver on librealsense, over optics with fault injection; the conformance suite has the contract."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from tests.support.errors import raises
from tests.support.faults_table import FaultsTable
from tests.support.hal.plain_source import PlainSource, colour_slope, wall_colour

if find_spec("pyrealsense2") is None:
    pytest.skip("pyrealsense2 has no wheel for this platform", allow_module_level=True)

import hal.compat.realsense as rs
from hal.backends.d405.camera import CameraHealth, D405Camera
from hal.backends.d405.session import D405CameraConfig, describe_missing
from hal.base import d405
from hal.base.errors import CameraError, HalTimeoutError, InvalidValueError, NotConnectedError
from hal.compat.realsense import port

SMALL = D405CameraConfig(width=424, height=240, warm_up_s=0.1)


@pytest.fixture
def source() -> PlainSource:
    return PlainSource()


@pytest.fixture
def camera(source: PlainSource) -> Iterator[D405Camera]:
    camera = D405Camera(SMALL, source=source)
    camera.connect()
    yield camera
    camera.disconnect()


def wait_through(camera: D405Camera, timeout_s: float) -> int:
    """Wait for frames, 0.5 s a call, until one arrives; return the number of calls that timed out."""
    for failed in range(round(timeout_s / 0.5)):
        try:
            camera.wait_for_frame(0.5)
        except HalTimeoutError:
            continue
        return failed
    raise AssertionError(f"no frame within {timeout_s} s")


# --- Frames -------------------------------------------------------------------------------------------------------


def test_depth_is_in_metres_by_the_scale_of_the_device(camera: D405Camera) -> None:
    frame = camera.wait_for_frame(1.0)
    assert frame.depth_m.dtype == np.float32
    np.testing.assert_allclose(frame.depth_m, 0.4, atol=1e-6)


def test_pinhole_of_depth_and_serial_of_the_device(camera: D405Camera) -> None:
    expected = d405.D405Calibration().depth(424, 240)
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(camera.intrinsics, name) == pytest.approx(getattr(expected, name), rel=1e-6)
    assert camera.wait_for_frame(1.0).serial == rs.SERIAL


@pytest.mark.integration
@pytest.mark.parametrize("size", list(d405.MIN_Z_M))
def test_colour_shows_the_same_as_depth_pixel_by_pixel(size: tuple[int, int]) -> None:
    camera = D405Camera(replace(SMALL, width=size[0], height=size[1]), source=PlainSource())
    camera.connect()
    frame = camera.wait_for_frame(1.0)
    camera.disconnect()
    valid = frame.colour[..., 2] == 128  # blue is constant, and black where the imager does not reach
    assert valid.mean() > 0.93
    error = np.abs(frame.colour.astype(float) - wall_colour(frame.intrinsics.rays()))[valid]
    error_px = error[:, :2] / colour_slope(frame.intrinsics.fx)
    assert np.percentile(error_px, 99) < 0.3  # bytes and resampling included
    assert error_px.mean() < 0.1


def test_the_rectified_image_needs_no_alignment() -> None:
    camera = D405Camera(replace(SMALL, colour="infrared"), source=PlainSource())
    camera.connect()
    frame = camera.wait_for_frame(1.0)
    camera.disconnect()
    expected = np.round(wall_colour(d405.D405Calibration().depth(424, 240).rays()))
    np.testing.assert_array_equal(frame.colour, expected)


def test_frames_of_the_warm_up_are_discarded() -> None:
    source = PlainSource()
    camera = D405Camera(replace(SMALL, warm_up_s=1.5), source=source)
    camera.connect()
    assert 101.5 < source.clock.now_s() < 101.7
    assert camera.health == CameraHealth()
    camera.disconnect()


def test_exposure_is_set_on_the_stereo_module_and_survives_a_reset(source: PlainSource, camera: D405Camera) -> None:
    camera.set_exposure(exposure_us=16_500)
    camera.wait_for_frame(1.0)
    assert source.requests[-1].brightness == pytest.approx(0.5)
    source.hangs = source.reset_cures = True
    wait_through(camera, 20.0)
    assert source.requests[-1].brightness == pytest.approx(0.5)
    camera.set_exposure()
    camera.wait_for_frame(1.0)
    assert source.requests[-1].brightness == 1.0
    with raises(InvalidValueError, "exposure"):
        camera.set_exposure(exposure_us=0)


# --- Faults -------------------------------------------------------------------------------------------------------


@pytest.mark.integration
def test_a_repeated_frame_is_not_delivered_again(source: PlainSource, camera: D405Camera) -> None:
    last = camera.wait_for_frame(1.0)
    source.repeats = source.restart_cures = True
    with raises(HalTimeoutError, "no_frame"):
        camera.wait_for_frame(0.5)
    assert camera.health.repeated >= 10
    wait_through(camera, 5.0)
    assert camera.health.restarts == 1
    assert camera.wait_for_frame(1.0).sequence > last.sequence


@pytest.mark.faults
def test_a_stale_frame_is_not_delivered(source: PlainSource, camera: D405Camera, faults_table: FaultsTable) -> None:
    good = source.expose
    held = []
    source.expose = lambda request: held.append(good(request)) or None  # type: ignore[method-assign]
    with pytest.raises(HalTimeoutError):
        camera.wait_for_frame(0.9)
    source.expose = lambda request: replace(held.pop(0), number=request.number)  # type: ignore[method-assign]
    with pytest.raises(HalTimeoutError) as caught:
        camera.wait_for_frame(0.05)
    assert camera.health.stale >= 1
    arm = f"waits; {camera.health.stale} stale frame(s) discarded"
    faults_table.add("stale frames", arm=arm, reads=caught.value)
    source.expose = good  # type: ignore[method-assign]
    frame = camera.wait_for_frame(1.0)
    assert source.clock.now_s() - frame.stamp_s < 0.05


def test_colour_of_another_instant_than_depth_is_not_delivered(source: PlainSource, camera: D405Camera) -> None:
    source.colour_stalls = True
    with pytest.raises(HalTimeoutError):
        camera.wait_for_frame(0.9)
    assert camera.health.torn > 0
    source.colour_stalls = False
    assert camera.wait_for_frame(1.0).depth_m.any()


@pytest.mark.integration
def test_streams_that_hang_are_restarted(source: PlainSource, camera: D405Camera) -> None:
    before = camera.wait_for_frame(1.0).sequence
    source.hangs = source.restart_cures = True
    assert wait_through(camera, 5.0) >= 1
    assert (camera.health.restarts, camera.health.resets, source.resets) == (1, 0, 0)
    assert camera.wait_for_frame(1.0).sequence > before


@pytest.mark.integration
def test_a_device_that_hangs_is_reset_and_reconnected(
    source: PlainSource, camera: D405Camera, caplog: pytest.LogCaptureFixture
) -> None:
    source.hangs = source.reset_cures = True
    wait_through(camera, 10.0)
    assert (camera.health.restarts, camera.health.resets, camera.health.reconnections) == (1, 1, 1)
    assert source.resets == 1
    assert "its hardware was reset" in caplog.text


@pytest.mark.integration
@pytest.mark.faults
def test_a_lost_camera_is_reconnected_when_it_returns(
    source: PlainSource, camera: D405Camera, faults_table: FaultsTable
) -> None:
    before = camera.wait_for_frame(1.0)
    source.attached = False
    for _ in range(8):
        called_s = source.clock.now_s()
        with pytest.raises(HalTimeoutError) as caught:
            camera.wait_for_frame(1.0)
        assert source.clock.now_s() - called_s == pytest.approx(1.0, abs=0.01)
    assert "it is searched for on the bus" in str(caught.value)
    source.attached, back_s = True, source.clock.now_s()
    wait_through(camera, 3.0)
    after = camera.wait_for_frame(1.0)
    faults_table.add(
        "USB camera lost, and back",
        arm=f"waits for frames, which return {after.stamp_s - back_s:.1f} s after the camera",
        reads=caught.value,
    )
    assert camera.health.reconnections == 1
    assert source.resets == 0
    assert after.sequence > before.sequence
    assert after.stamp_s > before.stamp_s + 8.0
    assert after.intrinsics == before.intrinsics


@pytest.mark.integration
def test_an_idle_camera_is_never_reset(source: PlainSource, camera: D405Camera) -> None:
    source.clock.sleep_until(source.clock.now_s() + 600.0)
    with pytest.raises(HalTimeoutError):
        camera.wait_for_frame(0.001)
    camera.wait_for_frame(1.0)
    assert (camera.health.restarts, camera.health.resets) == (0, 0)


@pytest.mark.integration
@pytest.mark.faults
def test_a_jump_of_the_systems_time_does_not_stop_it(
    source: PlainSource,
    camera: D405Camera,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    faults_table: FaultsTable,
) -> None:
    camera.wait_for_frame(1.0)
    jumped_s = source.clock.now_s()
    monkeypatch.setattr("hal.backends.d405.camera.unix_offset_s", lambda clock: 1.6e9 + 3600.0)
    frame = camera.wait_for_frame(2.0)
    assert 0.0 <= source.clock.now_s() - frame.stamp_s < 0.1
    arm = f"continues; the next frame is {frame.stamp_s - jumped_s:.2f} s later"
    faults_table.add("the system's time jumps by 1 h", arm=arm, reads=caplog.records[-1].getMessage())
    assert camera.health.resets == 0


@pytest.mark.integration
def test_a_camera_without_frames_cannot_be_connected_and_is_closed(source: PlainSource) -> None:
    source.hangs = True
    camera = D405Camera(SMALL, source=source)
    with raises(HalTimeoutError, "no_frame"):
        camera.connect()
    assert source.resets >= 1
    assert port.twins() == []
    with pytest.raises(NotConnectedError):
        camera.wait_for_frame(0.1)
    source.hangs = False
    camera.connect()
    camera.wait_for_frame(1.0)
    camera.disconnect()


# --- No camera ----------------------------------------------------------------------------------------------------


def test_without_a_camera_the_error_arrives_within_3_s_and_has_the_remedy(source: PlainSource) -> None:
    source.attached = False
    camera = D405Camera(SMALL, source=source)
    with raises(HalTimeoutError, "no_camera") as caught:
        camera.connect()
    assert source.clock.now_s() - 100.0 <= 3.0
    for part in ("8086:0B5B", rs.SERIAL, "found no RealSense camera", "USB 3 port", "lsusb -d 8086:", "--sim"):
        assert part in str(caught.value)


def test_another_serial_number_is_named(source: PlainSource) -> None:
    with rs.plugged(source):
        camera = D405Camera(replace(SMALL, serial="123456789012", search_s=0.0), clock=source.clock)
        with raises(HalTimeoutError, "no_camera") as caught:
            camera.connect()
        assert f"found {d405.NAME} {rs.SERIAL}" in str(caught.value)


@pytest.mark.integration
def test_one_of_two_cameras_must_be_chosen(source: PlainSource) -> None:
    with rs.plugged(source), rs.plugged(PlainSource(source.clock), "000000000406"):
        camera = D405Camera(SMALL, clock=source.clock)
        with raises(CameraError, "ambiguous_camera") as caught:
            camera.connect()
        assert f"2 cameras are connected: {rs.SERIAL}, 000000000406" in str(caught.value)
        chosen = D405Camera(replace(SMALL, serial="000000000406"), clock=source.clock)
        chosen.connect()
        assert chosen.wait_for_frame(1.0).serial == "000000000406"
        chosen.disconnect()


def test_a_camera_that_only_the_kernel_lists_needs_udev_rules(source: PlainSource, tmp_path: Path) -> None:
    (tmp_path / "2-1").mkdir()
    for name, text in {"idVendor": "8086", "idProduct": "0b5b", "speed": "5000"}.items():
        (tmp_path / "2-1" / name).write_text(f"{text}\n")
    source.attached = False
    with rs.plugged(source):
        text = describe_missing(rs, "", tmp_path)
        assert "The kernel lists one, at 5000 Mbit/s" in text
        assert "99-realsense-libusb.rules" in text
        assert "USB 3 port" in describe_missing(rs, "", tmp_path / "2-1")


@pytest.mark.integration
def test_a_camera_on_usb_2_is_reported(
    source: PlainSource, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hal.backends.d405.session._info", lambda rs, device, name: "2.1" if "usb" in name else "D405")
    monkeypatch.setattr(rs, "SERIAL", "D405")
    camera = D405Camera(SMALL, source=source)
    with caplog.at_level(logging.WARNING):
        camera.connect()
    camera.disconnect()
    assert "connected over USB 2.1" in caplog.text


@pytest.mark.parametrize(
    ("wrong", "code", "allowed"),
    [
        ({"width": 640, "height": 400}, "resolution", "640×400; allowed are: 848×480, 1280×720, 640×480"),
        ({"width": 1280, "height": 720, "rate_hz": 60}, "rate", "is 60; allowed at 1280×720 are: 5, 15, 30"),
        ({"colour": "rgb"}, "colour_stream", "allowed are: colour, infrared"),
        ({"gain": 300}, "exposure", "gain is 300; allowed is 16 to 248"),
        ({"silence_s": -1.0}, "duration", "silence_s is -1.0 s; allowed is 0 to 10000 s"),
    ],
)
def test_a_configuration_that_no_d405_has_is_rejected(wrong: dict, code: str, allowed: str) -> None:
    with raises(InvalidValueError, code) as caught:
        D405CameraConfig(**wrong)
    assert allowed in str(caught.value)
