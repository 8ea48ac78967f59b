"""OpenGL without a screen, through EGL."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from typing import TypeVar

import mujoco
import numpy as np

from hal.base.errors import CameraError, InvalidValueError

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
            "one of "
            "these.",
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
