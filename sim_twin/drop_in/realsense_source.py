"""Optics of the twin's D405 for librealsense: rectified depth, unrectified colour of the left imager."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Self

import cv2
import mujoco
import numpy as np

from hal.base.clock import Clock, WallClock
from hal.base.d405 import BASELINE_M, DEPTH_UNIT_M, MIN_Z_M, CaptureRequest, D405Calibration, Exposure
from hal.base.messages import Intrinsics
from sim_twin.backends import TwinClock, lower_thread_priority
from sim_twin.camera import d405
from sim_twin.camera.d405 import View, WristRenderer, camera_id
from sim_twin.camera.render import make_renderer
from sim_twin.model.world import SceneView, World


class TwinSource:
    """`hal.base.d405.FrameSource` of a world: `hal.compat.realsense.plug(TwinSource(world))`.

    Rendering has a thread of its own, as an OpenGL context belongs to one thread.

    Args:
        world: the scene.
        clock: a `TwinClock` of that world for lock-step (the default for a `World`), any other for free run.
        renderer: one of `sim_twin.camera.render.RENDERERS`; by default the environment's choice.
        calibration: optics of the unit; by default figures of real ones.
        low_priority: whether it renders at low priority in free run, as required in the process of a servo.
    """

    def __init__(
        self,
        world: SceneView,
        clock: Clock | None = None,
        renderer: str | None = None,
        calibration: D405Calibration | None = None,
        *,
        low_priority: bool = True,
    ) -> None:
        self.world = world
        if clock is None:
            clock = TwinClock(world) if isinstance(world, World) else WallClock()
        self.clock: Clock = clock
        self.lockstep = isinstance(self.clock, TwinClock)
        self.calibration = calibration if calibration is not None else D405Calibration()
        self.attached = True
        """Whether the cable is plugged in; writable, to inject a fault."""
        self._kind = renderer
        self._low_priority = low_priority and not self.lockstep
        self._snapshot = mujoco.MjData(world.model)
        self._optics: Optics | None = None
        self._renderer: WristRenderer | None = None
        self._thread: ThreadPoolExecutor | None = None

    def expose(self, request: CaptureRequest) -> Exposure:
        """Return an exposure of the present scene.

        Raises:
            CameraError: the requested renderer is not available.
        """
        if self._thread is None:
            initializer = lower_thread_priority if self._low_priority else None
            self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="twin-d405", initializer=initializer)
        return self._thread.submit(self._expose, request).result()

    def warm_up(self, width: int = 848, height: int = 480) -> None:
        """Open the renderer and render once, so that the first frame is as fast as the others."""
        self.expose(CaptureRequest(number=0, width=width, height=height, depth=True, colour=True))

    def reset(self) -> None:
        """Do nothing: these optics have no state to reset."""

    def close(self) -> None:
        """Free the renderer and its thread until the next `expose`."""
        thread, self._thread = self._thread, None
        if thread is not None:
            # In the renderer's own thread, to which its OpenGL context belongs
            thread.submit(self._close_renderer).result()
            thread.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _expose(self, request: CaptureRequest) -> Exposure:
        stamp_s = self.clock.now_s()
        data = self.world.snapshot(self._snapshot)
        optics, renderer = self._prepare(request)
        view = renderer.render(data)
        colour = optics.distort(view.colour) if request.colour else None
        left = view.colour[optics.window] if request.left else None
        right = self._render_right(renderer, data).colour[optics.window] if request.right else None
        return Exposure(
            number=request.number,
            stamp_s=stamp_s,
            depth=self._measure_depth(view.z_m[optics.window], optics.depth, request) if request.depth else None,
            colour=self._measure_image(colour, request, 0),
            left=self._measure_image(left, request, 1),
            right=self._measure_image(right, request, 2),
        )

    def _prepare(self, request: CaptureRequest) -> tuple[Optics, WristRenderer]:
        optics, renderer = self._optics, self._renderer
        if (
            optics is None
            or renderer is None
            or (optics.depth.width, optics.depth.height) != (request.width, request.height)
        ):
            self._close_renderer()
            optics = self._optics = Optics(self.calibration, request.width, request.height)
            renderer = self._renderer = make_renderer(
                self.world.model, optics.wide, self._kind, self.world.config.board, mask=False
            )
        return optics, renderer

    def _close_renderer(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None

    def _render_right(self, renderer: WristRenderer, data: mujoco.MjData) -> View:
        number = camera_id(self.world.model)
        x_axis = data.cam_xmat[number].reshape(3, 3)[:, 0]
        # In the snapshot only, whose cameras are computed again from the joints for each exposure
        data.cam_xpos[number] += BASELINE_M * x_axis
        return renderer.render(data)

    def _measure_depth(self, z_m: np.ndarray, pinhole: Intrinsics, request: CaptureRequest) -> np.ndarray:
        """Return the depth (H, W) in units."""
        config, min_z_m = self.world.config, MIN_Z_M[request.width, request.height]
        if config.noise:
            z_m = d405.measure_depth(np.ascontiguousarray(z_m), config.seed, request.number, pinhole, min_z_m)
        else:
            z_m = d405.round_depth(np.ascontiguousarray(z_m), min_z_m)
        return np.rint(z_m / DEPTH_UNIT_M).astype(np.uint16)

    def _measure_image(self, image: np.ndarray | None, request: CaptureRequest, imager: int) -> np.ndarray | None:
        if image is None:
            return None
        if request.brightness != 1.0:
            image = cv2.convertScaleAbs(image, alpha=request.brightness)
        if not self.world.config.noise:
            return image
        # Three imagers a frame: no two images share their noise
        return d405.measure_colour(np.ascontiguousarray(image), self.world.config.seed, 3 * request.number + imager)


class Optics:
    """Pixels of each stream in one wide pinhole image, which covers the fields of view of all of them.

    The wide image has the depth stream's focal length and pixel grid, so depth and infrared are a window of it and
    only colour is resampled.

    Args:
        calibration: optics of the unit.
        width: width of the streams [px].
        height: height of the streams [px].
    """

    def __init__(self, calibration: D405Calibration, width: int, height: int) -> None:
        pinhole = self.depth = calibration.depth(width, height)
        u, v = _colour_in_depth(calibration, width, height)
        # One more pixel on each side for the bilinear interpolation of the colour image
        left, top = (int(np.floor(min(a.min(), 0.0))) - 1 for a in (u, v))
        right, bottom = (int(np.ceil(max(a.max(), n))) + 1 for a, n in ((u, width), (v, height)))
        self.wide = Intrinsics(
            width=right - left,
            height=bottom - top,
            fx=pinhole.fx,
            fy=pinhole.fy,
            cx=pinhole.cx - left,
            cy=pinhole.cy - top,
        )
        self.window = (slice(-top, height - top), slice(-left, width - left))
        self._maps = (u - left).astype(np.float32), (v - top).astype(np.float32)

    def distort(self, wide: np.ndarray) -> np.ndarray:
        """Return the unrectified colour image (height, width, 3) of a wide one."""
        return cv2.remap(wide, *self._maps, cv2.INTER_LINEAR)


def _colour_in_depth(calibration: D405Calibration, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns and rows (height, width) of the colour pixels' rays in the depth stream's pinhole [px]."""
    colour, depth = calibration.colour(width, height), calibration.depth(width, height)
    pixels = np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float)), axis=-1)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    rays = cv2.undistortPointsIter(
        pixels.reshape(-1, 1, 2), colour.K, np.array(calibration.colour_coeffs), np.eye(3), np.eye(3), until
    )
    rays = cv2.convertPointsToHomogeneous(rays).reshape(-1, 3) @ calibration.R_colour_depth  # into depth axes
    u, v = depth.project(rays / rays[:, 2:]).T
    return u.reshape(height, width), v.reshape(height, width)
