"""A stage for a detector's pictures: arm, table, lights and a pool of props in one compiled model.

Everything that changes from picture to picture (poses, colours, textures, lights) changes inside the compiled model.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass

import mujoco
import numpy as np

from hal.messages import Intrinsics
from sim_twin.d405 import INTRINSICS
from sim_twin.detection_props import (
    CLASSES,
    HIDDEN_GROUP,
    Prop,
    add_prop,
    make_class_prop,
    make_distractor,
    nominal_prop,
)
from sim_twin.gl import Canvas
from sim_twin.render import set_pinhole
from sim_twin.scene import TABLE_RGBA
from sim_twin.textures import random_rgb, random_texture
from sim_twin.z1_mjcf import GROUP_ARM, GROUP_MOUNT, GROUP_SCENE, GROUP_VISUAL, add_z1

VARIANTS = 3
"""Props of each class beside the nominal one."""
DISTRACTORS = 14
_SKINS, _SKIN_PX = 10, 64
_SKIN_SHARE = 0.35
"""How many things have a texture; the others have one colour."""
_FLAT_PX = 256
_LIGHTS = 3
_WALLS = 4
_GEOMS_DRAWN = 800


@dataclass(frozen=True, slots=True, kw_only=True)
class Actor:
    """A prop on the stage, with the numbers of its body and geoms in the model."""

    prop: Prop
    mocap: int
    geoms: np.ndarray


class Stage:
    """Draws pictures with exact instance masks; belongs to the thread that made it.

    Args:
        seed: of the props' proportions.
        intrinsics: of both cameras, the wrist's and the free one.

    Raises:
        CameraError: there is no OpenGL through EGL.
    """

    def __init__(self, seed: int, intrinsics: Intrinsics = INTRINSICS) -> None:
        rng = np.random.default_rng([seed, 1])
        self.model, self.actors = _build(rng)
        self.data = mujoco.MjData(self.model)
        self.intrinsics = intrinsics
        os.environ.setdefault("LP_NUM_THREADS", "1")
        self._canvas = Canvas(self.model, intrinsics.width, intrinsics.height)
        self._scene = mujoco.MjvScene(self.model, maxgeom=_GEOMS_DRAWN)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        self._pixels = np.empty((intrinsics.height, intrinsics.width, 3), np.uint8)

    def named(self, kind: str) -> list[Actor]:
        """Return the actors of a class, the nominal one first."""
        return [actor for actor in self.actors if actor.prop.kind == kind]

    def distractors(self) -> list[Actor]:
        """Return the actors of no class."""
        return [actor for actor in self.actors if actor.prop.kind not in CLASSES]

    def clear(self) -> None:
        """Take every actor off the stage."""
        for actor in self.actors:
            self.hide(actor)

    def hide(self, actor: Actor) -> None:
        """Take `actor` off the stage."""
        self.model.geom_group[actor.geoms] = HIDDEN_GROUP

    def put(self, actor: Actor, T_base_prop: np.ndarray) -> None:
        """Show `actor` at `T_base_prop` (4, 4)."""
        self.model.geom_group[actor.geoms] = GROUP_SCENE
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, T_base_prop[:3, :3].ravel().copy())
        self.data.mocap_pos[actor.mocap], self.data.mocap_quat[actor.mocap] = T_base_prop[:3, 3], quat

    def pose(self, actor: Actor) -> np.ndarray:
        """Return where `actor` was put, T_base_prop (4, 4)."""
        pose, rotation = np.eye(4), np.empty(9)
        mujoco.mju_quat2Mat(rotation, self.data.mocap_quat[actor.mocap])
        pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), self.data.mocap_pos[actor.mocap]
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

    def dress_as_twin(self) -> None:
        """Give table, floor, walls and lights the twin's own look, and every nominal actor its own colours."""
        model = self.model
        for name in ("floor", "table"):
            self._set_texture(name, np.full((_FLAT_PX, _FLAT_PX, 3), 255, np.uint8))
        model.geom("floor").rgba, model.geom("table").rgba = [0.46, 0.48, 0.51, 1.0], TABLE_RGBA
        sky = np.linspace([0.93, 0.95, 0.97], [0.55, 0.66, 0.78], _FLAT_PX)[:, None] * np.ones((1, _FLAT_PX, 1))
        self._set_texture("sky", np.tile((sky * 255).astype(np.uint8), (6, 1, 1)))
        for number in range(_WALLS):
            model.geom(f"wall_{number}").group = HIDDEN_GROUP
        for actor in self.actors:
            self._dress_in_own_colours(actor)
        model.geom_rgba[self._arm_geoms()] = self._arm_rgba()
        model.light_active[:] = [1] + [0] * (_LIGHTS - 1)
        model.light_type[0] = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        model.light_pos[0], model.light_dir[0] = [-0.3, -1.2, 2.2], np.array([0.35, 0.7, -1.0]) / 1.27
        model.light_diffuse[0], model.light_specular[0] = [0.62, 0.60, 0.56], [0.25] * 3
        model.vis.headlight.ambient, model.vis.headlight.diffuse = [0.30, 0.30, 0.32], [0.25] * 3

    def dress_at_random(self, rng: np.random.Generator, but: Collection[Actor] = ()) -> None:
        """Give everything new colours, textures and lights; the actors `but` keep their own colours."""
        self._dress_surroundings(rng)
        for number in rng.permutation(_SKINS)[:4]:  # the others keep theirs from earlier pictures
            side = random_texture(rng, _SKIN_PX)
            self._set_texture(f"skin_{number}", np.tile(side, (6, 1, 1)))  # six of its own make a cylinder a box
        for actor in self.actors:
            self._dress_actor(actor, rng)
        for actor in but:
            self._dress_in_own_colours(actor)
        tint = np.append(rng.uniform(0.75, 1.2, 3) if rng.random() < 0.5 else np.ones(3), 1.0)
        grey = rng.uniform(0.0, 0.15)
        self.model.geom_rgba[self._arm_geoms()] = np.clip(
            (self._arm_rgba() + np.array([grey, grey, grey, 0])) * tint, 0, 1
        )
        self._light_at_random(rng)

    def draw(self, camera: str, arm: str, shadows: bool) -> np.ndarray:
        """Return the picture (H, W, 3) uint8 RGB.

        Args:
            camera: `wrist` or `free`.
            arm: `pieces`, as the twin's wrist camera sees it, `whole` with its camera, or `none`.
            shadows: whether lights throw them.
        """
        self._look(camera, arm, shadows)
        self._canvas.draw(self._scene, self._pixels)
        return np.ascontiguousarray(self._pixels[::-1])

    def draw_instances(self, camera: str, arm: str) -> np.ndarray:
        """Return which actor (index in `actors`) each pixel (H, W) int16 shows; −1 = none."""
        self._look(camera, arm, False)
        by_number = [int(mujoco.mjtRndFlag.mjRND_SEGMENT), int(mujoco.mjtRndFlag.mjRND_IDCOLOR)]
        self._scene.flags[by_number] = True
        self._canvas.draw(self._scene, self._pixels)
        self._scene.flags[by_number] = False
        owner = np.full(self.model.ngeom, -1, np.int16)
        for number, actor in enumerate(self.actors):
            owner[actor.geoms] = number
        table = np.full(65536, -1, np.int16)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                table[geom.segid + 1] = owner[geom.objid]
        pixels = self._pixels[::-1].astype(np.uint16)
        return table[pixels[..., 0] + 256 * pixels[..., 1]]

    def close(self) -> None:
        """Free the OpenGL context."""
        self._canvas.close()

    def _look(self, camera: str, arm: str, shadows: bool) -> None:
        self._option.geomgroup[:] = 0
        shown = {"pieces": [GROUP_ARM], "whole": [GROUP_VISUAL, GROUP_MOUNT], "none": []}[arm]
        self._option.geomgroup[[GROUP_SCENE, *shown]] = 1
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._camera.fixedcamid = self.model.camera(camera).id
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        category = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self.model, self.data, self._option, None, self._camera, category, self._scene)
        set_pinhole(self._scene, self.intrinsics)

    def _dress_surroundings(self, rng: np.random.Generator) -> None:
        model = self.model
        for name in ("floor", "table"):
            self._set_texture(name, random_texture(rng, _FLAT_PX))
            model.geom(name).rgba = np.append(rng.uniform(0.6, 1.0, 3) if rng.random() < 0.3 else np.ones(3), 1.0)
            model.mat_texrepeat[model.material(name).id] = rng.uniform(0.5, 6.0)
            model.mat_specular[model.material(name).id] = rng.uniform(0.0, 0.5)
        if rng.random() < 0.4:
            self._set_texture("sky", np.tile(random_texture(rng, _FLAT_PX), (6, 1, 1)))
        for number in range(_WALLS):
            wall = model.geom(f"wall_{number}")
            wall.group = GROUP_SCENE if rng.random() < 0.5 else HIDDEN_GROUP
            angle, far = rng.uniform(-1.3, 1.3), rng.uniform(1.2, 3.0)
            wall.pos = [far * np.cos(angle), far * np.sin(angle), rng.uniform(-0.5, 0.6)]
            half = rng.uniform(-0.5, 0.5)
            wall.quat = [np.cos((angle + half) / 2), 0.0, 0.0, np.sin((angle + half) / 2)]
            wall.size = [rng.uniform(0.02, 0.3), rng.uniform(0.2, 1.2), rng.uniform(0.2, 1.2)]
            self._dress_geoms(np.array([wall.id]), rng)

    def _dress_in_own_colours(self, actor: Actor) -> None:
        self.model.geom_matid[actor.geoms] = -1
        self.model.geom_rgba[actor.geoms] = [part.rgba for part, _ in actor.prop.parts]

    def _dress_actor(self, actor: Actor, rng: np.random.Generator) -> None:
        if actor.prop.kind == "bottle" and rng.random() < 0.7:  # body, label and cap each of one colour
            body, label, cap = (np.append(random_rgb(rng), 1.0) for _ in range(3))
            self.model.geom_matid[actor.geoms] = -1
            self.model.geom_rgba[actor.geoms] = body
            self.model.geom_rgba[actor.geoms[2]] = label
            self.model.geom_rgba[actor.geoms[-1]] = cap
            return
        self._dress_geoms(actor.geoms, rng)

    def _dress_geoms(self, geoms: np.ndarray, rng: np.random.Generator) -> None:
        """One skin or one colour for all of them."""
        if rng.random() < _SKIN_SHARE:
            number = self.model.material(f"skin_{rng.integers(_SKINS)}").id
            self.model.geom_matid[geoms] = number
            self.model.geom_rgba[geoms] = np.append(rng.uniform(0.7, 1.0, 3), 1.0)
            self.model.mat_specular[number], self.model.mat_shininess[number] = rng.uniform(0.0, 0.8, 2)
            return
        self.model.geom_matid[geoms] = -1
        self.model.geom_rgba[geoms] = np.append(random_rgb(rng), 1.0)

    def _light_at_random(self, rng: np.random.Generator) -> None:
        model = self.model
        ambient, head = rng.uniform(0.12, 0.45), rng.uniform(0.0, 0.45)
        model.vis.headlight.ambient = ambient * rng.uniform(0.85, 1.0, 3)
        model.vis.headlight.diffuse = head * rng.uniform(0.85, 1.0, 3)
        count = rng.integers(1, _LIGHTS + 1)
        for number in range(_LIGHTS):
            model.light_active[number] = number < count
            model.light_castshadow[number] = number == 0
            spot = rng.random() < 0.5
            kind = mujoco.mjtLightType
            model.light_type[number] = kind.mjLIGHT_SPOT if spot else kind.mjLIGHT_DIRECTIONAL
            place = np.array([rng.uniform(-1.2, 1.6), rng.uniform(-1.5, 1.5), rng.uniform(0.7, 2.5)])
            aim = np.array([0.5, 0.0, 0.0]) + rng.normal(0.0, 0.15, 3) - place
            model.light_pos[number], model.light_dir[number] = place, aim / np.linalg.norm(aim)
            model.light_cutoff[number], model.light_exponent[number] = rng.uniform(40, 80), rng.uniform(0, 8)
            strength = rng.uniform(0.2, 0.9) / np.sqrt(count)
            model.light_diffuse[number] = strength * rng.uniform(0.8, 1.0, 3)
            model.light_specular[number] = [rng.uniform(0.0, 0.5)] * 3

    def _set_texture(self, name: str, picture: np.ndarray) -> None:
        number = self.model.texture(name).id
        start = self.model.tex_adr[number]
        self.model.tex_data[start : start + picture.size] = picture.ravel()
        mujoco.mjr_uploadTexture(self.model, self._canvas.context, number)

    def _arm_geoms(self) -> np.ndarray:
        return np.flatnonzero(np.isin(self.model.geom_group, (GROUP_ARM, GROUP_VISUAL)))

    def _arm_rgba(self) -> np.ndarray:
        """The arm's own colours, remembered at the first call."""
        if not hasattr(self, "_own_arm_rgba"):
            self._own_arm_rgba = self.model.geom_rgba[self._arm_geoms()].copy()
        return self._own_arm_rgba


def _build(rng: np.random.Generator) -> tuple[mujoco.MjModel, list[Actor]]:
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
        Actor(
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
        spec.add_texture(name=name, type=kind.mjTEXTURE_2D, builtin=flat, width=_FLAT_PX, height=_FLAT_PX)
        spec.add_material(name=name, texrepeat=[3, 3]).textures[rgb] = name
    spec.add_texture(name="sky", type=kind.mjTEXTURE_SKYBOX, builtin=flat, width=_FLAT_PX, height=6 * _FLAT_PX)
    for number in range(_SKINS):
        name = f"skin_{number}"
        spec.add_texture(name=name, type=kind.mjTEXTURE_CUBE, builtin=flat, width=_SKIN_PX, height=6 * _SKIN_PX)
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
    for number in range(_WALLS):
        world.add_geom(name=f"wall_{number}", size=[0.1, 0.1, 0.1], rgba=[1, 1, 1, 1], **box)
    for number in range(_LIGHTS):
        world.add_light(name=f"light_{number}", pos=[0, 0, 2], dir=[0, 0, -1], castshadow=number == 0)
    world.add_body(name="free", mocap=True).add_camera(name="free", quat=[0.0, 1.0, 0.0, 0.0])
