"""The wrist camera's image without noise: colour, exact depth and the object's exact mask.

Two ways: OpenGL through EGL without a screen, or, where there is none, ray casting.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import mujoco
import numba
import numpy as np

from hal.base.errors import CameraError, InvalidValueError
from hal.base.messages import Intrinsics
from sim_twin.camera.d405 import View, WristRenderer, camera_id, object_geoms
from sim_twin.model.z1_mjcf import GROUP_ARM, GROUP_SCENE

if TYPE_CHECKING:  # few scenes have a board
    from sim_twin.model.charuco_board import BoardSpec

logger = logging.getLogger(__name__)

RENDER_VARIABLE = "Z1_TWIN_RENDER"
"""Environment variable that forces `egl` or `rays`; unset or `auto` takes the first that works."""
RENDERERS = ("auto", "egl", "rays")

T = TypeVar("T")
_warned = False
_size_lock = threading.Lock()


def choose(kind: str | None, with_gl: Callable[[], T], with_rays: Callable[[], T]) -> T:
    """Return the result of `with_gl` or, without OpenGL, of `with_rays`, with one warning.

    Args:
        kind: one of `RENDERERS`; None = what the environment variable says.
        with_gl: makes it with a `Canvas`.
        with_rays: makes it without.

    Raises:
        ValueError: no such kind.
        CameraError: EGL was asked for and there is none.
    """
    global _warned  # noqa: PLW0603 - one warning per process
    kind = kind or os.environ.get(RENDER_VARIABLE) or "auto"
    if kind not in RENDERERS:
        raise InvalidValueError(
            f"renderer: the kind is unknown ({kind!r}, allowed {', '.join(RENDERERS)}). Set {RENDER_VARIABLE} to "
            "one of these.",
            code="unknown_renderer",
        )
    if kind == "rays":
        return with_rays()
    try:
        return with_gl()
    except CameraError as error:
        if kind == "egl":
            raise
        if not _warned:
            _warned = True
            logger.warning("%s Until then the twin casts rays, with flat colours.", error)
        return with_rays()


class Canvas:
    """An offscreen framebuffer with a GL context of its own; belongs to the thread that made it.

    Args:
        model: what is drawn; its meshes and textures are loaded.
        width: of the image [px].
        height: of the image [px].
        samples: of each pixel; 0 = one, at its centre.

    Raises:
        CameraError: there is no OpenGL through EGL.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int, samples: int = 0) -> None:
        self._gl = open_egl(width, height)
        try:
            with _size_lock:  # the size travels in the model, which several threads may use
                model.vis.global_.offwidth, model.vis.global_.offheight = width, height
                model.vis.quality.offsamples = samples
                self.context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except mujoco.FatalError as error:
            self._gl.free()
            raise CameraError(_no_egl(error), code="no_egl") from error
        # MuJoCo draws into a window's buffer unless set otherwise, and EGL without a screen has none
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)
        self._rect = mujoco.MjrRect(0, 0, width, height)

    def draw(self, scene: mujoco.MjvScene, colour: np.ndarray, depth: np.ndarray | None = None) -> None:
        """Draw `scene` into `colour` (H, W, 3) uint8 and `depth` (H, W) float32; the bottom row comes first."""
        # A thread has one current context, and may have drawn on another canvas since
        self._gl.make_current()
        mujoco.mjr_render(self._rect, scene, self.context)
        mujoco.mjr_readPixels(colour, depth, self._rect, self.context)

    def close(self) -> None:
        """Free the context."""
        self._gl.make_current()
        self.context.free()
        self._gl.free()


def open_egl(width: int, height: int):
    """Return a GL context, current in this thread, for an image of that size.

    Raises:
        CameraError: there is no OpenGL through EGL.
    """
    from OpenGL.error import Error as GlError

    try:
        from mujoco.egl import GLContext

        context = GLContext(width, height)
        context.make_current()
    # MuJoCo raises ImportError where there is no driver, PyOpenGL AttributeError where there is no library.
    except (ImportError, AttributeError, RuntimeError, GlError) as error:
        raise CameraError(_no_egl(error), code="no_egl") from error
    return context


def _no_egl(error: Exception) -> str:
    return (
        f"renderer: OpenGL through EGL is not available ({error}). Install libegl1 and libgl1-mesa-dri, or set "
        f"{RENDER_VARIABLE}=rays."
    )


_NEAR_M, _FAR_M = 0.01, 20.0


def make_renderer(
    model: mujoco.MjModel,
    intrinsics: Intrinsics,
    kind: str | None = None,
    board: BoardSpec | None = None,
    *,
    mask: bool = True,
) -> WristRenderer:
    """Return a renderer for the calling thread.

    Args:
        model: the scene.
        intrinsics: of the wrist camera.
        kind: one of `sim_twin.camera.render.RENDERERS`; by default what the environment variable says.
        board: on the scene's table; rays have no textures.
        mask: False leaves the object's mask empty, which saves OpenGL a pass.

    Raises:
        ValueError: no such kind.
        CameraError: EGL was asked for and there is none.
    """

    def cast_rays() -> WristRenderer:
        from sim_twin.camera.rays import RayRenderer

        return RayRenderer(model, intrinsics, board)

    return choose(kind, lambda: EglRenderer(model, intrinsics, mask=mask), cast_rays)


def set_pinhole(scene: mujoco.MjvScene, intrinsics: Intrinsics) -> None:
    """Give OpenGL the pinhole: pixel centres are at whole numbers here and at halves there."""
    i = intrinsics
    for side in range(2):
        camera = scene.camera[side]
        camera.frustum_near, camera.frustum_far = _NEAR_M, _FAR_M
        camera.frustum_width = _NEAR_M * i.width / i.fx / 2
        camera.frustum_center = _NEAR_M * (i.width / 2 - (i.cx + 0.5)) / i.fx
        camera.frustum_top = _NEAR_M * (i.cy + 0.5) / i.fy
        camera.frustum_bottom = -_NEAR_M * (i.height - i.cy - 0.5) / i.fy


class EglRenderer:
    """Two passes on one framebuffer of the camera's size: geom numbers with depth, then colour.

    Without the mask one pass gives both depth and colour.
    """

    def __init__(self, model: mujoco.MjModel, intrinsics: Intrinsics, *, mask: bool = True) -> None:
        self._model, self._intrinsics, self._with_mask = model, intrinsics, mask
        width, height = intrinsics.width, intrinsics.height
        # Software GL would take every core for itself; one leaves the others to the servo. Read when GL is loaded.
        os.environ.setdefault("LP_NUM_THREADS", "1")
        self._canvas = Canvas(model, width, height)
        # Reversed depth: float32 is finest near 0, which offsets the coarseness of 1/z at a distance
        self._canvas.context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value
        self._scene = mujoco.MjvScene(model, maxgeom=500)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[[GROUP_SCENE, GROUP_ARM]] = 1
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        self._camera.fixedcamid = camera_id(model)
        self._is_object = object_geoms(model)
        self._ids = np.zeros((height, width, 3), np.uint8)
        self._inverse_z = np.empty((height, width), np.float32)

    def render(self, data: mujoco.MjData) -> View:
        """Draw the state `data` (kinematics computed)."""
        category = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._camera, category, self._scene)
        set_pinhole(self._scene, self._intrinsics)
        colour = np.empty_like(self._ids)
        if self._with_mask:
            z_m, mask = self._draw_depth_and_mask()
            self._canvas.draw(self._scene, colour)
        else:
            self._canvas.draw(self._scene, colour, self._inverse_z)
            z_m, mask = _decode(self._ids, self._inverse_z, np.zeros(1, np.bool_))
        return View(colour=np.ascontiguousarray(colour[::-1]), z_m=z_m, mask=mask)

    def close(self) -> None:
        """Free the context."""
        self._canvas.close()

    def _draw_depth_and_mask(self) -> tuple[np.ndarray, np.ndarray]:
        by_number = [int(mujoco.mjtRndFlag.mjRND_SEGMENT), int(mujoco.mjtRndFlag.mjRND_IDCOLOR)]
        self._scene.flags[by_number] = True
        self._canvas.draw(self._scene, self._ids, self._inverse_z)
        self._scene.flags[by_number] = False
        # MuJoCo draws `segid` + 1, so that 0 is the background
        is_object = np.zeros(self._scene.ngeom + 1, np.bool_)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                is_object[geom.segid + 1] = self._is_object[geom.objid]
        return _decode(self._ids, self._inverse_z, is_object)


@numba.njit(nogil=True, cache=True)
def _decode(ids: np.ndarray, inverse_z: np.ndarray, is_object: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return z (H, W) [m] and the object's mask (H, W) from OpenGL's buffers, which start at the bottom row.

    The depth buffer is reversed: d = near·(far − z) / (z·(far − near)); 0 is the far plane, where nothing was drawn.
    Compiled and without the GIL, so that a servo in the same process is not held up.
    """
    height, width = inverse_z.shape
    z_m, mask = np.zeros((height, width), np.float32), np.zeros((height, width), np.bool_)
    for v in range(height):
        row = height - 1 - v
        for u in range(width):
            if inverse_z[row, u] > 0.0:
                z_m[v, u] = _NEAR_M * _FAR_M / (_NEAR_M + inverse_z[row, u] * (_FAR_M - _NEAR_M))
            # The number's low byte is in red, the next one in green
            mask[v, u] = is_object[ids[row, u, 0] + 256 * ids[row, u, 1]]
    return z_m, mask
