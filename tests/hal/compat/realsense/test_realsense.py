"""`hal.compat.realsense` is pyrealsense2, with a twin as a camera."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.base import d405
from hal.base.clock import WallClock, unix_offset_s
from tests.support.hal.plain_source import WALL_UNITS, PlainSource, make_images

if find_spec("pyrealsense2") is None:
    pytest.skip("pyrealsense2 has no wheel for this platform", allow_module_level=True)

import hal.compat.realsense as rs
from hal.compat.realsense.library import native

SIZE = (424, 240)


@pytest.fixture
def source() -> PlainSource:
    return PlainSource()


@pytest.fixture
def twin(source: PlainSource) -> Iterator[rs.TwinDevice]:
    with rs.plugged(source) as device:
        yield device


def make_config(*streams: tuple, size: tuple[int, int] = SIZE, rate_hz: int = 30) -> Any:
    config = rs.config()
    for stream, index, format_ in streams or [
        (rs.stream.depth, 0, rs.format.z16),
        (rs.stream.color, 0, rs.format.rgb8),
    ]:
        config.enable_stream(stream, index, *size, format_, rate_hz)
    return config


def text_of(call: Any) -> str:
    with pytest.raises(RuntimeError) as caught:
        call()
    return str(caught.value)


# --- The module ---------------------------------------------------------------------------------------------------


def test_every_public_name_of_pyrealsense2_is_there() -> None:
    assert {name for name in dir(native) if not name.startswith("_")} <= set(dir(rs))
    assert (rs.__version__, rs.__full_version__) == (native.__version__, native.__full_version__)


def test_without_a_twin_the_library_is_unchanged() -> None:
    assert type(rs.context().query_devices()) is native.device_list
    with rs.plugged(PlainSource()):
        assert native.device.hardware_reset.__module__ == "hal.compat.realsense.port"
    assert getattr(native.device.hardware_reset, "__module__", None) != "hal.compat.realsense.port"


def test_masquerade_substitutes_pyrealsense2_and_restores_it() -> None:
    with rs.masquerade():
        import pyrealsense2
        import pyrealsense2.pyrealsense2 as older

        assert pyrealsense2 is rs
        assert older is rs
    import pyrealsense2

    assert pyrealsense2 is native


@pytest.mark.integration
def test_without_a_wheel_the_error_has_the_remedy() -> None:
    code = "import sys; sys.modules['pyrealsense2'] = None; import hal.compat.realsense"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    for part in ("SdkMissingError", "x86_64 Linux and Windows only", "-DBUILD_PYTHON_BINDINGS=ON", "--sim"):
        assert part in done.stderr


# --- The device ---------------------------------------------------------------------------------------------------


def test_a_twin_is_found_as_a_d405(twin: rs.TwinDevice) -> None:
    devices = rs.context().query_devices()
    assert (len(devices), devices.size()) == (1, 1)
    info = rs.camera_info
    identity = [devices.front().get_info(key) for key in (info.name, info.serial_number, info.product_id)]
    assert identity == ["Intel RealSense D405", twin.serial, "0B5B"]
    assert devices[0].get_info(info.product_line) == "D400"
    assert devices[0].get_info(info.usb_type_descriptor) == "3.2"
    assert text_of(lambda: devices[0].get_info(info.advanced_mode)) == "info Advanced Mode not supported by the device!"


def test_it_has_one_sensor_and_no_projector(twin: rs.TwinDevice) -> None:
    (device,) = rs.context().devices
    (sensor,) = rs.context().query_all_sensors()
    assert sensor.get_info(rs.camera_info.name) == "Stereo Module"
    assert text_of(device.first_color_sensor) == "Could not find requested sensor type!"
    assert not sensor.supports(rs.option.laser_power)
    expected = "object doesn't support option Laser Power"
    assert text_of(lambda: sensor.set_option(rs.option.laser_power, 1)) == expected
    assert text_of(lambda: rs.rs400_advanced_mode(device).is_enabled()) == 'null pointer passed for argument "dev"'


def test_it_has_the_options_of_a_d405_with_their_ranges(twin: rs.TwinDevice) -> None:
    sensor, option = twin.handle.first_depth_sensor(), rs.option
    ranges = {key: sensor.get_option_range(key) for key in (option.exposure, option.gain, option.enable_auto_exposure)}
    assert [(r.min, r.max, r.default) for r in ranges.values()] == [(1, 165_000, 33_000), (16, 248, 16), (0, 1, 1)]
    assert text_of(lambda: sensor.set_option(option.gain, 999)) == 'out of range value for argument "value"'
    assert sensor.get_option(option.frames_queue_size) == 16
    assert 0 < sensor.get_option(option.asic_temperature) < 42
    assert text_of(lambda: sensor.set_option(option.asic_temperature, 20)) == "This option is read-only!"


def test_depth_comes_in_tenths_of_a_millimetre_over_a_baseline_of_18(twin: rs.TwinDevice) -> None:
    sensor = twin.handle.first_depth_sensor()
    assert sensor.get_depth_scale() == pytest.approx(1e-4)
    assert sensor.get_option(rs.option.stereo_baseline) == pytest.approx(18.0)
    text = text_of(lambda: sensor.set_option(rs.option.depth_units, 1e-3))
    assert text == "This option is read-only!"


def test_every_profile_of_the_d405_is_there_and_no_other(twin: rs.TwinDevice) -> None:
    profiles = [p.as_video_stream_profile() for p in twin.handle.first_depth_sensor().get_stream_profiles()]
    depth = {(p.width(), p.height(), p.fps()) for p in profiles if p.stream_type() == rs.stream.depth}
    assert depth == {(w, h, hz) for w, h in d405.MIN_Z_M for hz in d405.rates_hz(w, h)}
    colour = {p.format() for p in profiles if p.stream_type() == rs.stream.color}
    assert colour == {rs.format.rgb8, rs.format.bgr8, rs.format.rgba8, rs.format.bgra8, rs.format.yuyv}
    infrared = {(p.stream_index(), p.format()) for p in profiles if p.stream_type() == rs.stream.infrared}
    assert {(1, rs.format.y8), (2, rs.format.y8), (0, rs.format.rgb8)} <= infrared


def test_colour_is_distorted_and_depth_is_not(twin: rs.TwinDevice) -> None:
    pipeline = rs.pipeline()
    profile = pipeline.start(make_config(size=(640, 480)))
    depth, colour = (profile.get_stream(s).as_video_stream_profile() for s in (rs.stream.depth, rs.stream.color))
    assert depth.get_intrinsics().model == rs.distortion.brown_conrady
    assert list(depth.get_intrinsics().coeffs) == [0.0] * 5
    assert colour.get_intrinsics().model == rs.distortion.inverse_brown_conrady
    assert colour.get_intrinsics().fx == pytest.approx(393.03, abs=0.01)
    assert colour.get_intrinsics().coeffs[0] == pytest.approx(-0.0506, abs=1e-4)
    pose = depth.get_extrinsics_to(colour)
    assert list(pose.translation) == [0.0, 0.0, 0.0]
    ray = d405.D405Calibration().R_colour_depth @ [0.1, 0.2, 1.0]
    assert rs.rs2_transform_point_to_point(pose, [0.1, 0.2, 1.0]) == pytest.approx(ray.tolist(), abs=1e-6)
    pipeline.stop()


def test_the_right_imager_is_18_mm_to_the_right(twin: rs.TwinDevice) -> None:
    pipeline = rs.pipeline()
    profile = pipeline.start(make_config((rs.stream.depth, 0, rs.format.z16), (rs.stream.infrared, 2, rs.format.y8)))
    pose = profile.get_stream(rs.stream.depth).get_extrinsics_to(profile.get_stream(rs.stream.infrared, 2))
    assert list(pose.translation) == pytest.approx([-0.018, 0.0, 0.0])
    pipeline.stop()


def test_exposure_and_gain_switch_auto_exposure_off_and_change_the_images(
    source: PlainSource, twin: rs.TwinDevice
) -> None:
    sensor = twin.handle.first_depth_sensor()
    pipeline = rs.pipeline()
    pipeline.start(make_config())
    pipeline.wait_for_frames()
    assert source.requests[-1].brightness == 1.0
    for option, value in ((rs.option.exposure, 16_500), (rs.option.gain, 32)):
        sensor.set_option(rs.option.enable_auto_exposure, 1)
        sensor.set_option(option, value)
        assert sensor.get_option(rs.option.enable_auto_exposure) == 0
    frames = pipeline.wait_for_frames()
    assert source.requests[-1].brightness == pytest.approx(0.5 * 2.0)
    metadata = rs.frame_metadata_value
    assert frames.get_depth_frame().get_frame_metadata(metadata.actual_exposure) == 16_500
    assert frames.get_depth_frame().get_frame_metadata(metadata.gain_level) == 32
    text = text_of(lambda: sensor.set_option(rs.option.exposure, 0))
    assert text == 'out of range value for argument "value"'
    pipeline.stop()


def test_a_filter_keeps_its_options_while_a_twin_is_plugged_in(twin: rs.TwinDevice) -> None:
    decimation = rs.decimation_filter()
    decimation.set_option(rs.option.filter_magnitude, 4)
    assert decimation.get_option(rs.option.filter_magnitude) == 4


def test_two_twins_differ_by_their_serial_numbers(twin: rs.TwinDevice) -> None:
    with pytest.raises(ValueError):
        rs.plug(PlainSource(), twin.serial)
    other = PlainSource()
    with rs.plugged(other, "000000000406"):
        assert len(rs.context().query_devices()) == 2
        config = make_config()
        rs.config.enable_device(config, "000000000406")
        pipeline = rs.pipeline()
        profile = pipeline.start(config)
        assert profile.get_device().get_info(rs.camera_info.serial_number) == "000000000406"
        pipeline.wait_for_frames()
        assert len(other.requests) == 1
        pipeline.stop()


# --- Frames -------------------------------------------------------------------------------------------------------


def test_frames_carry_the_exposure_of_the_optics(twin: rs.TwinDevice) -> None:
    pipeline = rs.pipeline()
    pipeline.start(make_config())
    frames = pipeline.wait_for_frames()
    assert (np.asanyarray(frames.get_depth_frame().get_data()) == WALL_UNITS).all()
    assert frames.get_depth_frame().get_distance(3, 4) == pytest.approx(0.4)
    assert (np.asanyarray(frames.get_color_frame().get_data()) == make_images(*SIZE)[1]).all()
    pipeline.stop()


@pytest.mark.parametrize(
    ("format_", "channels"),
    [("bgr8", (2, 1, 0)), ("rgba8", (0, 1, 2, None)), ("bgra8", (2, 1, 0, None))],
)
def test_colour_has_the_requested_format(twin: rs.TwinDevice, format_: str, channels: tuple) -> None:
    pipeline = rs.pipeline()
    pipeline.start(make_config((rs.stream.color, 0, rs.format.__members__[format_])))
    image = np.asanyarray(pipeline.wait_for_frames().get_color_frame().get_data())
    assert image.shape == (*SIZE[::-1], len(channels))
    for target, origin in enumerate(channels):
        assert (image[..., target] == (255 if origin is None else make_images(*SIZE)[1][..., origin])).all()
    pipeline.stop()


def test_the_imagers_come_in_grey_and_the_left_one_also_in_colour(twin: rs.TwinDevice) -> None:
    pipeline = rs.pipeline()
    infrared = rs.stream.infrared
    pipeline.start(
        make_config(
            (infrared, 1, rs.format.y8), (infrared, 2, rs.format.y8), (infrared, 0, rs.format.rgb8), size=(640, 480)
        )
    )
    frames = pipeline.wait_for_frames()
    left, right = (np.asanyarray(frames.get_infrared_frame(i).get_data()).astype(int) for i in (1, 2))
    assert left.shape == right.shape == (480, 640)
    assert np.abs(left + right - 255).max() <= 1
    assert (np.asanyarray(frames.get_color_frame().get_data()) == make_images(640, 480)[2]).all()
    pipeline.stop()


def test_yuyv_is_the_same_image_packed(twin: rs.TwinDevice) -> None:
    import cv2

    pipeline = rs.pipeline()
    pipeline.start(make_config((rs.stream.color, 0, rs.format.yuyv)))
    packed = np.asanyarray(pipeline.wait_for_frames().get_color_frame().get_data())
    assert (packed.shape, packed.dtype) == (SIZE[::-1], np.uint16)
    colour = cv2.cvtColor(packed.view(np.uint8).reshape(*SIZE[::-1], 2), cv2.COLOR_YUV2RGB_YUY2)
    assert np.abs(colour.astype(int) - make_images(*SIZE)[1]).mean() < 4
    pipeline.stop()


def test_in_lock_step_the_clock_advances_by_one_frame_a_wait(source: PlainSource, twin: rs.TwinDevice) -> None:
    pipeline = rs.pipeline()
    pipeline.start(make_config(rate_hz=60))
    frame_sets = [pipeline.wait_for_frames() for _ in range(4)]
    assert [f.get_frame_number() for f in frame_sets] == [1, 2, 3, 4]
    unix_s = unix_offset_s(source.clock)
    stamps = [1e-3 * f.get_timestamp() - unix_s for f in frame_sets]
    assert stamps == pytest.approx([100.0 + i / 60 for i in (1, 2, 3, 4)], abs=1e-6)
    assert frame_sets[0].get_depth_frame().get_frame_timestamp_domain() == rs.timestamp_domain.global_time
    assert source.clock.now_s() == pytest.approx(100.0 + 4 / 60)
    pipeline.stop()


def test_polling_and_trying_give_frames_in_lock_step_too(twin: rs.TwinDevice) -> None:
    pipeline = rs.pipeline()
    pipeline.start(make_config())
    assert pipeline.poll_for_frames().get_frame_number() == 1
    received, frames = pipeline.try_wait_for_frames(100)
    assert received
    assert frames.get_frame_number() == 2
    pipeline.stop()


def test_a_queue_gives_frames_in_lock_step_and_a_callback_is_rejected(twin: rs.TwinDevice) -> None:
    pipeline, queue = rs.pipeline(), rs.frame_queue(2)
    with pytest.raises(RuntimeError):
        pipeline.start(make_config(), lambda frame: None)
    pipeline.start(make_config(), queue)
    assert queue.wait_for_frame().as_frameset().get_depth_frame().get_frame_number() == 1
    for number in (2, 3):
        frames = queue.poll_for_frame().as_frameset()
        assert [f.get_frame_number() for f in frames] == [number, number]
    pipeline.stop()
    received, _ = queue.try_wait_for_frame(50)
    assert not received


@pytest.mark.integration
def test_in_free_run_frames_reach_callbacks_and_sensors() -> None:
    numbers, enough = [], threading.Event()

    def record(frame: Any) -> None:
        numbers.append(frame.get_frame_number())
        if len(numbers) == 3:
            enough.set()

    with rs.plugged(PlainSource(WallClock())) as twin:
        pipeline = rs.pipeline()
        pipeline.start(make_config(), record)
        assert enough.wait(60)
        pipeline.stop()
        assert numbers == sorted(numbers)
        numbers.clear()
        enough.clear()
        (sensor,) = twin.handle.query_sensors()
        depth = next(p for p in sensor.get_stream_profiles() if p.stream_type() == rs.stream.depth)
        sensor.open(depth)
        sensor.start(record)
        assert enough.wait(60)
        sensor.stop()
        sensor.close()


@pytest.mark.integration
def test_in_free_run_frames_are_stamped_with_unix_time() -> None:
    with rs.plugged(PlainSource(WallClock())):
        pipeline = rs.pipeline()
        pipeline.start(make_config())
        frames = pipeline.wait_for_frames(60_000)
        arrival_ms = frames.get_frame_metadata(rs.frame_metadata_value.time_of_arrival)
        assert abs(frames.get_timestamp() - arrival_ms) < 10_000
        assert frames.get_timestamp() > 1.7e12  # November 2023
        pipeline.stop()


@pytest.mark.integration
def test_optics_that_fail_take_the_twin_off_the_bus(caplog: pytest.LogCaptureFixture) -> None:
    source = PlainSource(WallClock())
    source.expose = lambda request: 1 / 0  # type: ignore[method-assign]
    with rs.plugged(source) as twin:
        pipeline = rs.pipeline()
        pipeline.start(make_config())
        text = text_of(lambda: pipeline.wait_for_frames(2000))
        assert text == "Device disconnected. Failed to reconnect: No device connected2000"
        assert not twin.present
    assert "ZeroDivisionError" in caplog.text


def test_an_image_of_the_wrong_type_never_reaches_the_library(source: PlainSource, twin: rs.TwinDevice) -> None:
    good = source.expose
    pipeline = rs.pipeline()
    pipeline.start(make_config())
    for bad in (np.zeros((10, 10), np.uint16), np.zeros(SIZE[::-1], np.float32)):
        source.expose = lambda request, bad=bad: d405.Exposure(number=1, stamp_s=0.0, depth=bad)  # type: ignore[method-assign]
        with pytest.raises(ValueError):
            pipeline.wait_for_frames()
    source.expose = good  # type: ignore[method-assign]
    assert pipeline.wait_for_frames()
    pipeline.stop()


def test_default_streams(twin: rs.TwinDevice) -> None:
    pipeline = rs.pipeline()
    streams = [p.as_video_stream_profile() for p in pipeline.start().get_streams()]
    profiles = {(p.stream_type(), p.format(), p.width(), p.height(), p.fps()) for p in streams}
    assert profiles == {
        (rs.stream.depth, rs.format.z16, 848, 480, 30),
        (rs.stream.color, rs.format.rgb8, 848, 480, 30),
    }
    pipeline.stop()
    config = rs.config()
    config.enable_all_streams()
    assert len(pipeline.start(config).get_streams()) == 4
    pipeline.stop()


# --- Errors -------------------------------------------------------------------------------------------------------


def test_errors_of_use_read_as_the_librarys(twin: rs.TwinDevice) -> None:
    for call in ("wait_for_frames", "try_wait_for_frames", "poll_for_frames", "stop", "get_active_profile"):
        assert text_of(getattr(rs.pipeline(), call)) == text_of(getattr(native.pipeline(), call))
    pipeline = rs.pipeline()
    pipeline.start(make_config())
    assert text_of(pipeline.start) == "start() cannot be called before stop()"
    assert pipeline.wait_for_frames()
    pipeline.stop()
    text = text_of(lambda: rs.pipeline().start(make_config(size=(640, 400))))
    assert text == "Couldn't resolve requests"
    mixed = make_config((rs.stream.depth, 0, rs.format.z16))
    mixed.enable_stream(rs.stream.color, 640, 480, rs.format.rgb8, 30)
    assert text_of(lambda: rs.pipeline().start(mixed)) == "Couldn't resolve requests"


@pytest.mark.integration
def test_a_timeout_reads_as_the_librarys_and_takes_only_the_twins_time(
    source: PlainSource, twin: rs.TwinDevice
) -> None:
    silent = native.pipeline()
    with rs.plugged(PlainSource(), "000000000406") as other:
        silent.set_device(other.handle)
        silent.start(make_config())
        expected = text_of(lambda: silent.wait_for_frames(70))
        silent.stop()
    source.hangs = True
    pipeline = rs.pipeline()
    pipeline.start(make_config())
    before_s = source.clock.now_s()
    assert text_of(lambda: pipeline.wait_for_frames(70)) == expected
    assert source.clock.now_s() == pytest.approx(before_s + 0.07)
    assert text_of(pipeline.wait_for_frames) == "Frame didn't arrive within 5000"
    pipeline.stop()


def test_an_absent_camera_is_not_connected(source: PlainSource, twin: rs.TwinDevice) -> None:
    config = make_config()
    config.enable_device("123456789012")
    assert text_of(lambda: rs.pipeline().start(config)) == "No device connected"
    assert not config.can_resolve(rs.pipeline_wrapper(rs.pipeline()))
    assert make_config().can_resolve(rs.pipeline_wrapper(rs.pipeline()))
    source.attached = False
    assert text_of(lambda: rs.pipeline().start(make_config())) == "No device connected"
    devices = rs.context().query_devices()
    assert len(devices) == 0
    assert text_of(devices.front) == text_of(native.context().query_devices().front)
    with pytest.raises(IndexError):
        devices[0]


def test_a_cable_pulled_and_put_back(source: PlainSource, twin: rs.TwinDevice) -> None:
    pipeline = rs.pipeline()
    pipeline.start(make_config())
    pipeline.wait_for_frames()
    source.attached = False
    text = text_of(lambda: pipeline.wait_for_frames(300))
    assert text == "Device disconnected. Failed to reconnect: No device connected300"
    source.attached = True
    assert pipeline.wait_for_frames().get_frame_number() > 5
    pipeline.stop()


def test_a_hardware_reset_takes_it_off_the_bus_for_a_while(source: PlainSource, twin: rs.TwinDevice) -> None:
    events = []
    context = rs.context()
    context.set_devices_changed_callback(events.append)
    (device,) = context.query_devices()
    pipeline = rs.pipeline()
    profile = pipeline.start(make_config())
    profile.get_device().hardware_reset()
    assert (len(context.query_devices()), source.resets) == (0, 1)
    assert events[0].was_removed(device)
    assert events[0].get_new_devices() == []
    assert pipeline.wait_for_frames(5000)
    assert source.clock.now_s() >= 100.0 + d405.RESET_S
    assert len(context.query_devices()) == 1
    assert events[1].was_added(device)
    assert not events[1].was_removed(device)
    pipeline.stop()


def test_an_unplugged_twin_does_not_return(source: PlainSource) -> None:
    pipeline = rs.pipeline()
    with rs.plugged(source):
        pipeline.start(make_config())
        pipeline.wait_for_frames()
        pipeline.stop()
    assert source.closed == 1
    assert text_of(lambda: pipeline.start(make_config())) == "No device connected"


# --- Recordings ---------------------------------------------------------------------------------------------------


@pytest.mark.integration
def test_a_recording_replays_the_recorded_frames(twin: rs.TwinDevice, tmp_path: Path) -> None:
    file = str(tmp_path / "wall.db3")
    config = make_config()
    config.enable_record_to_file(file)
    pipeline = rs.pipeline()
    pipeline.start(config)
    recorded = [pipeline.wait_for_frames().get_frame_number() for _ in range(6)]
    pipeline.stop()
    assert Path(file).read_bytes().startswith(b"SQLite format 3")

    config = rs.config()
    config.enable_device_from_file(file, repeat_playback=False)
    profile = pipeline.start(config)
    playback = profile.get_device().as_playback()
    playback.set_real_time(False)
    assert profile.get_device().get_info(rs.camera_info.name) == d405.NAME
    assert profile.get_device().first_depth_sensor().get_depth_scale() == pytest.approx(1e-4)
    played = []
    while (attempt := pipeline.try_wait_for_frames(1000))[0]:
        played.append(attempt[1].get_frame_number())
        assert (np.asanyarray(attempt[1].get_depth_frame().get_data()) == WALL_UNITS).all()
        assert (np.asanyarray(attempt[1].get_color_frame().get_data()) == make_images(*SIZE)[1]).all()
    assert len(played) >= 5
    assert set(played) <= set(recorded)
    pipeline.stop()

    pipeline.start(make_config())  # and live again
    assert pipeline.wait_for_frames()
    pipeline.stop()


def test_only_a_db3_is_written_and_a_missing_file_is_named(twin: rs.TwinDevice, tmp_path: Path) -> None:
    config = make_config()
    config.enable_record_to_file(str(tmp_path / "wall.bag"))
    assert text_of(lambda: rs.pipeline().start(config)).startswith("Output file must have .db3 extension")
    config = rs.config()
    config.enable_device_from_file("/nowhere/wall.db3")
    assert "/nowhere/wall.db3" in text_of(lambda: rs.pipeline().start(config))
