"""The scene from outside, for people: pictures and the README, never for the robot."""

from __future__ import annotations

import mujoco
import numpy as np

from hal.errors import CameraError
from sim_twin.render import make_context
from sim_twin.z1_mjcf import GROUP_MOUNT, GROUP_SCENE, GROUP_VISUAL

_LOOK_AT_M = (0.25, 0.0, 0.19)
_DISTANCE_M = 0.90
_AZIMUTH_DEG, _ELEVATION_DEG = 122.0, -14.0
_SAMPLES = 8


class OutsideView:
    """A fixed camera beside the table; belongs to the thread that made it.

    Raises:
        CameraError: there is no OpenGL through EGL.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        try:
            from mujoco.egl import GLContext

            self._gl = GLContext(width, height)
        except (ImportError, AttributeError, RuntimeError) as error:
            raise CameraError(f"pictures from outside need OpenGL through EGL ({error}); install libegl1.") from error
        self._gl.make_current()
        self._model = model
        self._context = make_context(model, width, height, samples=_SAMPLES)
        self._scene = mujoco.MjvScene(model, maxgeom=500)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION.value] = False
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[[GROUP_SCENE, GROUP_VISUAL, GROUP_MOUNT]] = 1
        self._camera = mujoco.MjvCamera()
        self._camera.lookat[:] = _LOOK_AT_M
        self._camera.distance, self._camera.azimuth, self._camera.elevation = _DISTANCE_M, _AZIMUTH_DEG, _ELEVATION_DEG
        self._rect = mujoco.MjrRect(0, 0, width, height)

    def render(self, data: mujoco.MjData) -> np.ndarray:
        """Return a picture (height, width, 3) uint8 of the state `data` (kinematics computed)."""
        self._gl.make_current()
        category = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._camera, category, self._scene)
        mujoco.mjr_render(self._rect, self._scene, self._context)
        colour = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_readPixels(colour, None, self._rect, self._context)
        return np.ascontiguousarray(colour[::-1])

    def close(self) -> None:
        """Free the context."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()
