"""The twin's optics for librealsense, against exact renderings of the same scene."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec

import cv2
import numpy as np
import pytest

from hal.backends.d405.camera import D405Camera
from hal.backends.d405.session import D405CameraConfig
from hal.base.clock import WallClock
from hal.base.d405 import BASELINE_M, DEPTH_UNIT_M, MIN_Z_M, CaptureRequest, Exposure
from hal.base.messages import Intrinsics
from sim_twin.camera.d405 import View
from sim_twin.camera.render import make_renderer
from sim_twin.drop_in.realsense_source import Optics, TwinSource
from sim_twin.model.charuco_board import BoardSpec
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.gl_here import needs_egl

needs_librealsense = pytest.mark.skipif(find_spec("pyrealsense2") is None, reason="pyrealsense2 has no wheel here")


@pytest.fixture(scope="module")
def patchwork() -> World:
    """A table covered with grey squares, whose corners can be found to a tenth of a pixel; no noise."""
    squares = np.random.default_rng(0).integers(30, 230, (24, 24)).astype(np.uint8)
    board = BoardSpec(image=np.kron(squares, np.ones((24, 24), np.uint8)), size_m=(0.6, 0.6))
    return World(SceneConfig(noise=False, board=board))


@pytest.fixture
def source(world: World) -> Iterator[TwinSource]:
    with TwinSource(world) as source:
        yield source


def expose(
    source: TwinSource, width: int = 640, height: int = 480, number: int = 1, **images: bool | float
) -> Exposure:
    return source.expose(CaptureRequest(number=number, width=width, height=height, **images))  # type: ignore[arg-type]


def render_exact(world: World, pinhole: Intrinsics) -> View:
    renderer = make_renderer(world.model, pinhole, board=world.config.board)
    view = renderer.render(world.snapshot())
    renderer.close()
    return view


def to_grey(image: np.ndarray | None) -> np.ndarray:
    assert image is not None
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def measure_shifts(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return corners (N, 2) of one grey image, and their shifts (N, 2) in the other [px]."""
    corners = cv2.goodFeaturesToTrack(first, 300, 0.02, 8)
    tracked, found, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, winSize=(15, 15))
    back, again, _ = cv2.calcOpticalFlowPyrLK(second, first, tracked, None, winSize=(15, 15))
    valid = (found & again).ravel().astype(bool) & (np.linalg.norm((back - corners).reshape(-1, 2), axis=1) < 0.3)
    return corners.reshape(-1, 2)[valid], (tracked - corners).reshape(-1, 2)[valid]


@pytest.mark.integration
def test_depth_equals_the_exact_rendering_of_its_pinhole(patchwork: World) -> None:
    with TwinSource(patchwork) as source:
        depth = expose(source, depth=True).depth
    assert depth is not None
    exact_m = render_exact(patchwork, source.calibration.depth(640, 480)).z_m
    measured = depth > 0
    assert measured.mean() > 0.8
    error_m = np.abs(DEPTH_UNIT_M * depth - exact_m)[measured]
    assert np.median(error_m) < DEPTH_UNIT_M
    assert np.percentile(error_m, 99.5) < 2 * DEPTH_UNIT_M


@pytest.mark.integration
@needs_egl
@needs_librealsense
def test_the_driver_undistorts_colour_onto_depth_to_a_fraction_of_a_pixel(patchwork: World) -> None:
    camera = D405Camera(D405CameraConfig(serial="twin", warm_up_s=0.0), source=TwinSource(patchwork))
    camera.connect()
    frame = camera.wait_for_frame(1.0)
    camera.disconnect()
    assert frame.serial == "twin"
    corners, error = measure_shifts(to_grey(render_exact(patchwork, frame.intrinsics).colour), to_grey(frame.colour))
    assert len(corners) > 150
    assert np.ptp(corners, axis=0) @ [1 / 640, 1 / 480] > 1.7  # all over the image
    assert np.median(np.linalg.norm(error, axis=1)) < 0.1
    assert np.percentile(np.linalg.norm(error, axis=1), 95) < 0.25


@pytest.mark.integration
@needs_egl
def test_colour_has_the_distortion_of_the_raw_imager(patchwork: World) -> None:
    with TwinSource(patchwork) as source:
        exposure = expose(source, colour=True, left=True)
    _, error = measure_shifts(to_grey(exposure.left), to_grey(exposure.colour))
    assert np.median(np.linalg.norm(error, axis=1)) > 5.0


@pytest.mark.integration
@needs_egl
def test_the_right_image_is_shifted_by_the_disparity(patchwork: World) -> None:
    with TwinSource(patchwork) as source:
        exposure = expose(source, depth=True, left=True, right=True)
        focal_px = source.calibration.depth(640, 480).fx
    assert exposure.depth is not None
    corners, shift = measure_shifts(to_grey(exposure.left), to_grey(exposure.right))
    columns, rows = np.rint(corners).astype(int).T
    z_m = DEPTH_UNIT_M * exposure.depth[rows, columns]
    known = z_m > 0
    assert known.sum() > 50
    np.testing.assert_allclose(np.median(shift[known, 0] + focal_px * BASELINE_M / z_m[known]), 0.0, atol=0.2)
    np.testing.assert_allclose(np.median(shift[known, 1]), 0.0, atol=0.1)


@pytest.mark.integration
@pytest.mark.parametrize("size", list(MIN_Z_M))
def test_every_stream_is_within_the_wide_image(size: tuple[int, int], source: TwinSource) -> None:
    optics = Optics(source.calibration, *size)
    wide = np.zeros((optics.wide.height, optics.wide.width, 3), np.uint8)
    wide[optics.window] = 255
    assert (wide == 255).sum() == 3 * size[0] * size[1]
    assert optics.distort(np.full_like(wide, 255)).min() == 255
    assert optics.wide.width < 1.1 * size[0]


@pytest.mark.integration
def test_no_depth_below_the_min_z_of_the_resolution(source: TwinSource) -> None:
    exact_m = render_exact(source.world, source.calibration.depth(1280, 720)).z_m
    assert 0.0 < exact_m[exact_m > 0].min() < MIN_Z_M[1280, 720]
    depth = expose(source, 1280, 720, depth=True).depth
    assert depth is not None
    assert DEPTH_UNIT_M * depth[depth > 0].min() >= MIN_Z_M[1280, 720] - 1e-9


@pytest.mark.integration
def test_the_left_edge_without_stereo_overlap_is_empty(source: TwinSource) -> None:
    depth = expose(source, depth=True).depth
    assert depth is not None
    assert not depth[:, :3].any()
    assert (depth[100:400, 100:500] > 0).mean() > 0.6


@pytest.mark.integration
def test_noise_differs_between_frames_and_is_reproducible(source: TwinSource) -> None:
    images = {"depth": True, "colour": True, "left": True}
    first, again, other = (expose(source, number=number, **images) for number in (1, 1, 2))
    for name in images:
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()
        assert getattr(first, name).tobytes() != getattr(other, name).tobytes()


@pytest.mark.integration
def test_half_the_exposure_is_half_the_brightness(patchwork: World) -> None:
    with TwinSource(patchwork) as source:
        bright, dark = (expose(source, colour=True, brightness=b).colour for b in (1.0, 0.5))
    assert bright is not None
    assert dark is not None
    np.testing.assert_allclose(dark, bright / 2, atol=1)


@pytest.mark.integration
def test_only_requested_images_are_made(source: TwinSource) -> None:
    exposure = expose(source, depth=True)
    assert exposure.depth is not None
    assert exposure.colour is exposure.left is exposure.right is None


@pytest.mark.integration
@needs_librealsense
def test_the_same_world_gives_librealsense_the_same_frames() -> None:
    import hal.compat.realsense as rs

    runs = []
    for _ in range(2):
        with TwinSource(World(SceneConfig(seed=3)), renderer="rays") as source, rs.plugged(source):
            pipeline, config = rs.pipeline(), rs.config()
            config.enable_stream(rs.stream.depth, 424, 240, rs.format.z16, 30)
            config.enable_stream(rs.stream.color, 424, 240, rs.format.rgb8, 30)
            pipeline.start(config)
            for _ in range(3):
                frames = pipeline.wait_for_frames()
            images = [np.asanyarray(frame.get_data()).tobytes() for frame in frames]
            runs.append((frames.get_timestamp(), images))
            pipeline.stop()
    assert runs[0] == runs[1]


@pytest.mark.integration
@needs_librealsense
def test_the_driver_gets_frames_by_the_wall_clock(world: World) -> None:
    with TwinSource(world, WallClock()) as source:
        source.warm_up(424, 240)
        # Long timeouts, for a busy machine
        config = D405CameraConfig(
            width=424, height=240, warm_up_s=0.0, connect_timeout_s=60.0, silence_s=60.0, max_age_s=60.0
        )
        camera = D405Camera(config, source=source)
        camera.connect()
        first, second = camera.wait_for_frame(60.0), camera.wait_for_frame(60.0)
        camera.disconnect()
    assert second.sequence > first.sequence
    assert second.stamp_s > first.stamp_s
