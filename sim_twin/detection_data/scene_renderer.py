"""Renderer of a detector's images: arm, table, lights and a pool of props in one compiled model.

Everything that changes from image to image (poses, colours, textures, lights) changes inside the compiled model.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import mujoco
import numpy as np

from hal.base.messages import Intrinsics
from sim_twin.camera.d405 import INTRINSICS
from sim_twin.camera.render import Canvas, set_pinhole
from sim_twin.detection_data.props import (
    CLASSES,
    UNDRAWN_GROUP,
    Prop,
    add_prop,
    make_class_prop,
    make_distractor,
    nominal_prop,
)
from sim_twin.model.z1_mjcf import GROUP_ARM, GROUP_MOUNT, GROUP_SCENE, GROUP_VISUAL, add_z1

VARIANTS = 3
"""Props of each class in addition to the nominal one."""
DISTRACTORS = 14
SKINS, SKIN_PX = 10, 64
"""Number of textures of the props, `skin_0` …, and width of each of a skin's six sides."""
FLAT_PX = 256
"""Width of the textures `floor`, `table` and of each side of `sky`."""
LIGHTS, WALLS = 3, 4
_GEOMS_DRAWN = 800


@dataclass(frozen=True, slots=True, kw_only=True)
class PropInstance:
    """A prop of the renderer, with the numbers of its body and geoms in the model."""

    prop: Prop
    mocap: int
    geoms: np.ndarray


class SceneRenderer:
    """Renderer of images with exact instance masks; belongs to the thread that made it.

    Args:
        seed: of the props' proportions.
        intrinsics: of both cameras, the wrist's and the free one.

    Raises:
        CameraError: there is no OpenGL through EGL.
    """

    def __init__(self, seed: int, intrinsics: Intrinsics = INTRINSICS) -> None:
        rng = np.random.default_rng([seed, 1])
        self.model, self.props = _build(rng)
        self.data = mujoco.MjData(self.model)
        self.arm_geoms = np.flatnonzero(np.isin(self.model.geom_group, (GROUP_ARM, GROUP_VISUAL)))
        self.arm_rgba = self.model.geom_rgba[self.arm_geoms].copy()
        self.intrinsics = intrinsics
        # As in `EglRenderer`: Mesa reads it when GL is loaded
        os.environ.setdefault("LP_NUM_THREADS", "1")
        self._canvas = Canvas(self.model, intrinsics.width, intrinsics.height)
        self._scene = mujoco.MjvScene(self.model, maxgeom=_GEOMS_DRAWN)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        self._pixels = np.empty((intrinsics.height, intrinsics.width, 3), np.uint8)

    def named(self, kind: str) -> list[PropInstance]:
        """Return the props of a class, the nominal one first."""
        return [instance for instance in self.props if instance.prop.kind == kind]

    def distractors(self) -> list[PropInstance]:
        """Return the props of no class."""
        return [instance for instance in self.props if instance.prop.kind not in CLASSES]

    def clear(self) -> None:
        """Remove every prop from the scene."""
        for instance in self.props:
            self.hide(instance)

    def hide(self, instance: PropInstance) -> None:
        """Remove `instance` from the scene."""
        self.model.geom_group[instance.geoms] = UNDRAWN_GROUP

    def is_shown(self, instance: PropInstance) -> bool:
        """Return whether `instance` is in the scene."""
        return bool(self.model.geom_group[instance.geoms[0]] == GROUP_SCENE)

    def put(self, instance: PropInstance, T_base_prop: np.ndarray) -> None:
        """Show `instance` at `T_base_prop` (4, 4)."""
        self.model.geom_group[instance.geoms] = GROUP_SCENE
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, T_base_prop[:3, :3].ravel().copy())
        self.data.mocap_pos[instance.mocap], self.data.mocap_quat[instance.mocap] = T_base_prop[:3, 3], quat

    def pose(self, instance: PropInstance) -> np.ndarray:
        """Return the pose T_base_prop (4, 4) of `instance`."""
        pose, rotation = np.eye(4), np.empty(9)
        mujoco.mju_quat2Mat(rotation, self.data.mocap_quat[instance.mocap])
        pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), self.data.mocap_pos[instance.mocap]
        return pose

    def set_arm(self, q: np.ndarray) -> np.ndarray:
        """Put the arm at joint positions `q` (7,) [rad]; return T_base_camera (4, 4) of the wrist camera."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        return self.T_base_camera("wrist")

    def T_base_camera(self, name: str) -> np.ndarray:
        """Return the optical frame (4, 4) of camera `name`, `wrist` or `free`."""
        pose = np.eye(4)
        pose[:3, :3] = self.data.cam(name).xmat.reshape(3, 3) * [1, -1, -1]
        pose[:3, 3] = self.data.cam(name).xpos
        return pose

    def set_free_camera(self, T_base_camera: np.ndarray) -> None:
        """Put the free camera's optical frame at `T_base_camera` (4, 4)."""
        number = self.model.body("free").mocapid[0]
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, T_base_camera[:3, :3].ravel().copy())
        self.data.mocap_pos[number], self.data.mocap_quat[number] = T_base_camera[:3, 3], quat
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def set_texture(self, name: str, picture: np.ndarray) -> None:
        """Exchange texture `name` for `picture` (rows, columns, 3) uint8, a cube's six sides one below the other."""
        number = self.model.texture(name).id
        start = self.model.tex_adr[number]
        self.model.tex_data[start : start + picture.size] = picture.ravel()
        mujoco.mjr_uploadTexture(self.model, self._canvas.context, number)

    def draw(self, camera: str, arm: str, shadows: bool) -> np.ndarray:
        """Return the picture (H, W, 3) uint8 RGB.

        Args:
            camera: `wrist` or `free`.
            arm: `pieces`, as in the twin's wrist camera, `whole` with its camera, or `none`.
            shadows: whether lights throw them.
        """
        self._update_scene(camera, arm, shadows)
        self._canvas.draw(self._scene, self._pixels)
        # OpenGL's first row is the bottom one
        return np.ascontiguousarray(self._pixels[::-1])

    def draw_instances(self, camera: str, arm: str) -> np.ndarray:
        """Return the index in `props` of each pixel's prop, (H, W) int16; −1 = none."""
        self._update_scene(camera, arm, False)
        by_number = [int(mujoco.mjtRndFlag.mjRND_SEGMENT), int(mujoco.mjtRndFlag.mjRND_IDCOLOR)]
        self._scene.flags[by_number] = True
        self._canvas.draw(self._scene, self._pixels)
        self._scene.flags[by_number] = False
        owner = np.full(self.model.ngeom, -1, np.int16)
        for number, instance in enumerate(self.props):
            owner[instance.geoms] = number
        # Red and green hold a geom's number, 16 bits
        table = np.full(65536, -1, np.int16)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                table[geom.segid + 1] = owner[geom.objid]
        pixels = self._pixels[::-1].astype(np.uint16)
        return table[pixels[..., 0] + 256 * pixels[..., 1]]

    def close(self) -> None:
        """Free the OpenGL context."""
        self._canvas.close()

    def _update_scene(self, camera: str, arm: str, shadows: bool) -> None:
        self._option.geomgroup[:] = 0
        shown = {"pieces": [GROUP_ARM], "whole": [GROUP_VISUAL, GROUP_MOUNT], "none": []}[arm]
        self._option.geomgroup[[GROUP_SCENE, *shown]] = 1
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._camera.fixedcamid = self.model.camera(camera).id
        # Poses of mocap bodies take effect with the kinematics
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        category = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self.model, self.data, self._option, None, self._camera, category, self._scene)
        set_pinhole(self._scene, self.intrinsics)


def _build(rng: np.random.Generator) -> tuple[mujoco.MjModel, list[PropInstance]]:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.stat.extent, spec.stat.center = 1.0, [0.3, 0.0, 0.2]
    spec.visual.map.shadowclip, spec.visual.quality.shadowsize = 1.0, 1024
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    _add_materials(spec)
    _add_room(spec)
    add_z1(spec)
    props = [nominal_prop(name) for name in CLASSES]
    props += [make_class_prop(name, rng) for name in CLASSES for _ in range(VARIANTS)]
    props += [make_distractor(rng) for _ in range(DISTRACTORS)]
    geoms = [add_prop(spec, prop, f"prop_{number}") for number, prop in enumerate(props)]
    model = spec.compile()
    return model, [
        PropInstance(
            prop=prop,
            mocap=int(model.body(f"prop_{number}").mocapid[0]),
            geoms=np.array([model.geom(name).id for name in geoms[number]]),
        )
        for number, prop in enumerate(props)
    ]


def _add_materials(spec: mujoco.MjSpec) -> None:
    kind, rgb = mujoco.mjtTexture, mujoco.mjtTextureRole.mjTEXROLE_RGB
    flat = mujoco.mjtBuiltin.mjBUILTIN_FLAT
    for name in ("floor", "table"):
        spec.add_texture(name=name, type=kind.mjTEXTURE_2D, builtin=flat, width=FLAT_PX, height=FLAT_PX)
        spec.add_material(name=name, texrepeat=[3, 3]).textures[rgb] = name
    # MuJoCo stores a cube's six square sides one below the other
    spec.add_texture(name="sky", type=kind.mjTEXTURE_SKYBOX, builtin=flat, width=FLAT_PX, height=6 * FLAT_PX)
    for number in range(SKINS):
        name = f"skin_{number}"
        spec.add_texture(name=name, type=kind.mjTEXTURE_CUBE, builtin=flat, width=SKIN_PX, height=6 * SKIN_PX)
        spec.add_material(name=name).textures[rgb] = name
    for name, rgba in (  # of the arm and its mount
        ("link", (0.86, 0.88, 0.91, 1)),
        ("dark", (0.20, 0.22, 0.26, 1)),
        ("jaw", (0.15, 0.16, 0.19, 1)),
        ("camera", (0.62, 0.64, 0.67, 1)),
        ("bracket", (0.10, 0.10, 0.11, 1)),
    ):
        spec.add_material(name=name, rgba=rgba, specular=0.5, shininess=0.4)


def _add_room(spec: mujoco.MjSpec) -> None:
    world = spec.worldbody
    box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "group": GROUP_SCENE, "contype": 0, "conaffinity": 0}
    world.add_geom(name="floor", pos=[0, 0, -0.76], size=[4, 4, 0.01], material="floor", **box)
    world.add_geom(name="table", pos=[0.35, 0, -0.02], size=[0.65, 0.60, 0.02], material="table", **box)
    for number in range(WALLS):
        world.add_geom(name=f"wall_{number}", size=[0.1, 0.1, 0.1], rgba=[1, 1, 1, 1], **box)
    for number in range(LIGHTS):
        world.add_light(name=f"light_{number}", pos=[0, 0, 2], dir=[0, 0, -1], castshadow=number == 0)
    world.add_body(name="free", mocap=True).add_camera(name="free", quat=[0.0, 1.0, 0.0, 0.0])
