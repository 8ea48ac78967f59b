"""The scene from outside, for reports and documentation, never for the robot."""

from __future__ import annotations

import io

import mujoco
import numpy as np
from PIL import Image

from hal.base.messages import Intrinsics
from sim_twin.camera.rays import RayCaster
from sim_twin.camera.render import Canvas, choose
from sim_twin.model.scene import SceneConfig, build_model
from sim_twin.model.z1_mjcf import GROUP_MOUNT, GROUP_SCENE, GROUP_VISUAL

_GROUPS = (GROUP_SCENE, GROUP_VISUAL, GROUP_MOUNT)
_LOOK_AT_M = np.array([0.25, 0.0, 0.21])
_DISTANCE_M = 0.80
_AZIMUTH_DEG, _ELEVATION_DEG = 122.0, -14.0
_PASSES = 8
_SUN_RADIUS = 0.03
"""Half width of the sun from the table, as a slope: pictures with suns all over it add up to soft shadows."""


def draw_picture(config: SceneConfig, qpos: np.ndarray, width: int = 1280, height: int = 720) -> bytes:
    """Return a PNG file of the scene `config` with MuJoCo's positions `qpos` (nq,)."""
    model = build_model(config)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    file = io.BytesIO()
    Image.fromarray(render_external(model, data, width, height)).save(file, format="PNG", optimize=True)
    return file.getvalue()


def render_external(
    model: mujoco.MjModel, data: mujoco.MjData, width: int, height: int, kind: str | None = None
) -> np.ndarray:
    """Return a picture (height, width, 3) uint8, from the table's side, of the state `data` (kinematics computed).

    Args:
        model: the scene.
        data: its state.
        width: [px].
        height: [px].
        kind: one of `sim_twin.camera.render.RENDERERS`; by default what the environment variable says.
    """
    return choose(
        kind, lambda: _draw_with_gl(model, data, width, height), lambda: _draw_with_rays(model, data, width, height)
    )


def _draw_with_gl(model: mujoco.MjModel, data: mujoco.MjData, width: int, height: int) -> np.ndarray:
    canvas = Canvas(model, width, height)
    scene, option, camera = mujoco.MjvScene(model, maxgeom=500), mujoco.MjvOption(), mujoco.MjvCamera()
    scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION.value] = False
    option.geomgroup[:] = 0
    option.geomgroup[list(_GROUPS)] = 1
    camera.lookat[:] = _LOOK_AT_M
    camera.distance, camera.azimuth, camera.elevation = _DISTANCE_M, _AZIMUTH_DEG, _ELEVATION_DEG
    # Eight passes of up to 255 each fit 16 bits
    total, colour = np.zeros((height, width, 3), np.uint16), np.empty((height, width, 3), np.uint8)
    try:
        for offset in _spread(_PASSES):
            mujoco.mjv_updateScene(model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, scene)
            _shift(scene, offset, height)
            canvas.draw(scene, colour)
            total += colour
    finally:
        canvas.close()
    return np.ascontiguousarray((total // _PASSES).astype(np.uint8)[::-1])


def _spread(n: int) -> np.ndarray:
    """Return points (n, 2) that fill [−1, 1]² evenly: the R2 sequence (Roberts 2018)."""
    # The plastic number, the real root of x³ = x + 1
    plastic = 1.32471795724474602596
    return 2.0 * ((0.5 + np.outer(np.arange(1, n + 1), [1 / plastic, 1 / plastic**2])) % 1.0) - 1.0


def _shift(scene: mujoco.MjvScene, offset: np.ndarray, height: int) -> None:
    """Move the picture by a part of a pixel, which smooths edges, and the sun over its disc, which softens shadows."""
    for camera in scene.camera:
        pixel_m = (camera.frustum_top - camera.frustum_bottom) / height
        camera.frustum_center += 0.5 * pixel_m * offset[0]
        camera.frustum_top += 0.5 * pixel_m * offset[1]
        camera.frustum_bottom += 0.5 * pixel_m * offset[1]
    for light in scene.lights[: scene.nlight]:
        if not light.headlight:
            light.dir[:2] += _SUN_RADIUS * offset
            light.ambient[:], light.diffuse[:] = 0.16, 0.50


def _draw_with_rays(model: mujoco.MjModel, data: mujoco.MjData, width: int, height: int) -> np.ndarray:
    focal = height / 2 / np.tan(np.deg2rad(model.vis.global_.fovy) / 2)
    # Pixel centres are at whole numbers, so the image's middle is at half of its size less one
    intrinsics = Intrinsics(width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2)
    azimuth, elevation = np.deg2rad([_AZIMUTH_DEG, _ELEVATION_DEG])
    forward = np.array([*(np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    T_base_camera = np.eye(4)
    T_base_camera[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T_base_camera[:3, 3] = _LOOK_AT_M - _DISTANCE_M * forward
    return RayCaster(model, intrinsics, _GROUPS).cast(data, T_base_camera)[0]
