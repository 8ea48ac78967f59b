"""Rendering without OpenGL: one ray a pixel; depth and mask exact, colour flat-shaded."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from hal.base.messages import Intrinsics
from sim_twin.camera.d405 import View, camera_id, object_geoms
from sim_twin.model.charuco_board import PRINT_GEOM, BoardSpec, project_print
from sim_twin.model.z1_mjcf import GROUP_ARM, GROUP_SCENE

_SKY = np.array([205, 214, 224], np.uint8)
_TO_LIGHT = np.array([-0.28, -0.56, 0.78])
_AMBIENT, _DIFFUSE = 0.55, 0.45
_FAR_M = 20.0


class RayCaster:
    """Casts every pixel's ray through MuJoCo's bounding-volume trees.

    Args:
        model: the scene.
        intrinsics: of the camera.
        groups: the visible geom groups.
    """

    def __init__(self, model: mujoco.MjModel, intrinsics: Intrinsics, groups: Sequence[int]) -> None:
        i = intrinsics
        self._model, self._size = model, (i.height, i.width)
        rays = i.rays().reshape(-1, 3)
        self._lengths = np.linalg.norm(rays, axis=1)
        self._rays = rays / self._lengths[:, None]
        self._groups = np.zeros(mujoco.mjNGROUP, np.uint8)
        self._groups[list(groups)] = 1
        rgba = np.where(model.geom_matid[:, None] >= 0, model.mat_rgba[model.geom_matid], model.geom_rgba)
        self._rgb = 255.0 * rgba[:, :3]

    def cast(self, data: mujoco.MjData, T_base_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Render from `T_base_camera` (4, 4), optical axes, the state `data` (kinematics computed).

        Returns:
            Colour (H, W, 3) uint8, distance along the optical axis (H, W) float32 [m] (0 where nothing is hit), and
            the numbers (H, W) of the geoms (−1 where nothing is hit).
        """
        n, rays = len(self._rays), self._rays @ T_base_camera[:3, :3].T
        geoms, ranges, normals = np.empty(n, np.int32), np.empty(n), np.zeros((n, 3))
        origin = T_base_camera[:3, 3].copy()
        mujoco.mj_multiRay(
            self._model, data, origin, rays.ravel(), self._groups, True, -1, geoms, ranges, normals.ravel(), n, _FAR_M
        )
        hit = geoms >= 0
        # Rays have unit length, z = 1 before the normalisation: dividing gives the distance along the optical axis
        z_m = np.where(hit, ranges / self._lengths, 0.0).astype(np.float32)
        light = _AMBIENT + _DIFFUSE * np.clip(normals @ _TO_LIGHT, 0.0, 1.0)
        colour = np.where(hit[:, None], self._rgb[geoms] * light[:, None], _SKY)
        return (
            np.clip(colour, 0, 255).astype(np.uint8).reshape(*self._size, 3),
            z_m.reshape(self._size),
            geoms.reshape(self._size),
        )


class RayRenderer:
    """The wrist camera by rays; a `board` on the table is painted over where its print is hit."""

    def __init__(self, model: mujoco.MjModel, intrinsics: Intrinsics, board: BoardSpec | None = None) -> None:
        self._intrinsics, self._board = intrinsics, board
        self._print = model.geom(PRINT_GEOM).id if board is not None else None
        self._caster = RayCaster(model, intrinsics, (GROUP_SCENE, GROUP_ARM))
        self._camera = camera_id(model)
        self._is_object = np.append(object_geoms(model), False)  # geom −1: nothing hit

    def render(self, data: mujoco.MjData) -> View:
        """Draw the state `data` (kinematics computed)."""
        T_base_camera = np.eye(4)
        # OpenGL's camera points along −z with y up.
        T_base_camera[:3, :3] = data.cam_xmat[self._camera].reshape(3, 3) * [1.0, -1.0, -1.0]
        T_base_camera[:3, 3] = data.cam_xpos[self._camera]
        colour, z_m, geoms = self._caster.cast(data, T_base_camera)
        if self._board is not None:
            visible = geoms == self._print
            ink = project_print(self._board, self._intrinsics, T_base_camera)[visible][:, None] / 255.0
            # A product, so that the plate's shading remains under the print
            colour[visible] = np.round(ink * colour[visible])
        return View(colour=colour, z_m=z_m, mask=self._is_object[geoms])

    def close(self) -> None:
        """Nothing is held."""
