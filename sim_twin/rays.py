"""Rendering without OpenGL: one ray a pixel; depth and mask exact, colour flat-shaded."""

from __future__ import annotations

import mujoco
import numpy as np

from hal.messages import Intrinsics
from sim_twin.render import View, camera_id, object_geoms
from sim_twin.z1_mjcf import GROUP_ARM, GROUP_SCENE

_SKY = np.array([205, 214, 224], np.uint8)
_TO_LIGHT = np.array([-0.28, -0.56, 0.78])
_AMBIENT, _DIFFUSE = 0.55, 0.45


class RayRenderer:
    """Casts every pixel's ray through MuJoCo's bounding-volume trees."""

    def __init__(self, model: mujoco.MjModel, intrinsics: Intrinsics) -> None:
        i = intrinsics
        self._model, self._size = model, (i.height, i.width)
        u, v = np.meshgrid(np.arange(i.width), np.arange(i.height))
        rays = np.stack([(u - i.cx) / i.fx, (v - i.cy) / i.fy, np.ones_like(u, float)], axis=-1).reshape(-1, 3)
        self._lengths = np.linalg.norm(rays, axis=1)
        self._rays = rays / self._lengths[:, None]
        self._groups = np.zeros(mujoco.mjNGROUP, np.uint8)
        self._groups[[GROUP_SCENE, GROUP_ARM]] = 1
        self._is_object = np.append(object_geoms(model), False)  # geom −1: nothing hit
        rgba = np.where(model.geom_matid[:, None] >= 0, model.mat_rgba[model.geom_matid], model.geom_rgba)
        self._rgb = 255.0 * rgba[:, :3]

    def render(self, data: mujoco.MjData) -> View:
        """Draw the state `data` (kinematics computed)."""
        camera, n = camera_id(self._model), len(self._rays)
        R_base_gl = data.cam_xmat[camera].reshape(3, 3)
        R_base_camera = R_base_gl * [1.0, -1.0, -1.0]  # OpenGL's camera looks along −z with y up
        rays = self._rays @ R_base_camera.T
        geoms, ranges, normals = np.empty(n, np.int32), np.empty(n), np.zeros((n, 3))
        origin = data.cam_xpos[camera].copy()
        mujoco.mj_multiRay(
            self._model, data, origin, rays.ravel(), self._groups, True, -1, geoms, ranges, normals.ravel(), n, 20.0
        )
        hit = geoms >= 0
        z_m = np.where(hit, ranges / self._lengths, 0.0).astype(np.float32)
        light = _AMBIENT + _DIFFUSE * np.clip(normals @ _TO_LIGHT, 0.0, 1.0)
        colour = np.where(hit[:, None], self._rgb[geoms] * light[:, None], _SKY)
        return View(
            colour=np.clip(colour, 0, 255).astype(np.uint8).reshape(*self._size, 3),
            z_m=z_m.reshape(self._size),
            mask=self._is_object[geoms].reshape(self._size),
        )

    def close(self) -> None:
        """Nothing is held."""
