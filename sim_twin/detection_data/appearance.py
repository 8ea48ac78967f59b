"""Appearance of a detector's scene: the twin's own, or domain-randomised colours, textures and lights."""

from __future__ import annotations

from collections.abc import Collection

import mujoco
import numpy as np

from sim_twin.detection_data.props import UNDRAWN_GROUP
from sim_twin.detection_data.scene_renderer import FLAT_PX, LIGHTS, SKIN_PX, SKINS, WALLS, PropInstance, SceneRenderer
from sim_twin.detection_data.textures import random_rgb, random_texture
from sim_twin.model.scene import TABLE_RGBA
from sim_twin.model.z1_mjcf import GROUP_SCENE

_TEXTURED = 0.35
"""Ratio of props with a texture; the others have one colour."""


def apply_twin_appearance(renderer: SceneRenderer) -> None:
    """Give table, floor, walls and lights the twin's own appearance, and every nominal prop its own colours."""
    model = renderer.model
    for name in ("floor", "table"):
        renderer.set_texture(name, np.full((FLAT_PX, FLAT_PX, 3), 255, np.uint8))
    model.geom("floor").rgba, model.geom("table").rgba = [0.46, 0.48, 0.51, 1.0], TABLE_RGBA
    sky = np.linspace([0.93, 0.95, 0.97], [0.55, 0.66, 0.78], FLAT_PX)[:, None] * np.ones((1, FLAT_PX, 1))
    renderer.set_texture("sky", np.tile((sky * 255).astype(np.uint8), (6, 1, 1)))
    for number in range(WALLS):
        model.geom(f"wall_{number}").group = UNDRAWN_GROUP
    for instance in renderer.props:
        _apply_own_colours(model, instance)
    model.geom_rgba[renderer.arm_geoms] = renderer.arm_rgba
    model.light_active[:] = [1] + [0] * (LIGHTS - 1)
    model.light_type[0] = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    # 1.27 is the direction's length: the compiler, which would divide by it, has run before
    model.light_pos[0], model.light_dir[0] = [-0.3, -1.2, 2.2], np.array([0.35, 0.7, -1.0]) / 1.27
    model.light_diffuse[0], model.light_specular[0] = [0.62, 0.60, 0.56], [0.25] * 3
    model.vis.headlight.ambient, model.vis.headlight.diffuse = [0.30, 0.30, 0.32], [0.25] * 3


def randomize_appearance(
    renderer: SceneRenderer, rng: np.random.Generator, keep: Collection[PropInstance] = ()
) -> None:
    """Give everything new colours, textures and lights; the props `keep` keep their own colours."""
    _randomize_surroundings(renderer, rng)
    for number in rng.permutation(SKINS)[:4]:  # the others keep theirs from earlier pictures
        side = random_texture(rng, SKIN_PX)
        renderer.set_texture(f"skin_{number}", np.tile(side, (6, 1, 1)))  # six of its own make a cylinder a box
    for instance in renderer.props:
        _randomize_prop(renderer.model, instance, rng)
    for instance in keep:
        _apply_own_colours(renderer.model, instance)
    tint = np.append(rng.uniform(0.75, 1.2, 3) if rng.random() < 0.5 else np.ones(3), 1.0)
    grey = rng.uniform(0.0, 0.15)
    renderer.model.geom_rgba[renderer.arm_geoms] = np.clip(
        (renderer.arm_rgba + np.array([grey, grey, grey, 0])) * tint, 0, 1
    )
    _randomize_lights(renderer.model, rng)


def _randomize_surroundings(renderer: SceneRenderer, rng: np.random.Generator) -> None:
    model = renderer.model
    for name in ("floor", "table"):
        renderer.set_texture(name, random_texture(rng, FLAT_PX))
        model.geom(name).rgba = np.append(rng.uniform(0.6, 1.0, 3) if rng.random() < 0.3 else np.ones(3), 1.0)
        model.mat_texrepeat[model.material(name).id] = rng.uniform(0.5, 6.0)
        model.mat_specular[model.material(name).id] = rng.uniform(0.0, 0.5)
    if rng.random() < 0.4:
        renderer.set_texture("sky", np.tile(random_texture(rng, FLAT_PX), (6, 1, 1)))
    for number in range(WALLS):
        wall = model.geom(f"wall_{number}")
        wall.group = GROUP_SCENE if rng.random() < 0.5 else UNDRAWN_GROUP
        angle, far = rng.uniform(-1.3, 1.3), rng.uniform(1.2, 3.0)
        wall.pos = [far * np.cos(angle), far * np.sin(angle), rng.uniform(-0.5, 0.6)]
        half = rng.uniform(-0.5, 0.5)
        wall.quat = [np.cos((angle + half) / 2), 0.0, 0.0, np.sin((angle + half) / 2)]
        wall.size = [rng.uniform(0.02, 0.1), *rng.uniform(0.6, 1.5, 2)]  # a small one, far off, would be a box
        _randomize_geoms(model, np.array([wall.id]), rng)


def _apply_own_colours(model: mujoco.MjModel, instance: PropInstance) -> None:
    model.geom_matid[instance.geoms] = -1
    model.geom_rgba[instance.geoms] = [part.rgba for part, _ in instance.prop.parts]


def _randomize_prop(model: mujoco.MjModel, instance: PropInstance, rng: np.random.Generator) -> None:
    if instance.prop.kind == "bottle" and rng.random() < 0.7:  # body, label and cap each of one colour
        body, label, cap = (np.append(random_rgb(rng), 1.0) for _ in range(3))
        model.geom_matid[instance.geoms] = -1
        model.geom_rgba[instance.geoms] = body
        model.geom_rgba[instance.geoms[2]] = label
        model.geom_rgba[instance.geoms[-1]] = cap
        return
    _randomize_geoms(model, instance.geoms, rng)


def _randomize_geoms(model: mujoco.MjModel, geoms: np.ndarray, rng: np.random.Generator) -> None:
    """One skin or one colour for all of them."""
    if rng.random() < _TEXTURED:
        number = model.material(f"skin_{rng.integers(SKINS)}").id
        model.geom_matid[geoms] = number
        model.geom_rgba[geoms] = np.append(rng.uniform(0.7, 1.0, 3), 1.0)
        model.mat_specular[number], model.mat_shininess[number] = rng.uniform(0.0, 0.8, 2)
        return
    model.geom_matid[geoms] = -1
    model.geom_rgba[geoms] = np.append(random_rgb(rng), 1.0)


def _randomize_lights(model: mujoco.MjModel, rng: np.random.Generator) -> None:
    ambient, head = rng.uniform(0.12, 0.45), rng.uniform(0.0, 0.45)
    model.vis.headlight.ambient = ambient * rng.uniform(0.85, 1.0, 3)
    model.vis.headlight.diffuse = head * rng.uniform(0.85, 1.0, 3)
    count = rng.integers(1, LIGHTS + 1)
    for number in range(LIGHTS):
        model.light_active[number] = number < count
        model.light_castshadow[number] = number == 0
        spot = rng.random() < 0.5
        kind = mujoco.mjtLightType
        model.light_type[number] = kind.mjLIGHT_SPOT if spot else kind.mjLIGHT_DIRECTIONAL
        place = np.array([rng.uniform(-1.2, 1.6), rng.uniform(-1.5, 1.5), rng.uniform(0.7, 2.5)])
        aim = np.array([0.5, 0.0, 0.0]) + rng.normal(0.0, 0.15, 3) - place
        model.light_pos[number], model.light_dir[number] = place, aim / np.linalg.norm(aim)
        model.light_cutoff[number], model.light_exponent[number] = rng.uniform(40, 80), rng.uniform(0, 8)
        # Several lights are weaker each, so that the image does not saturate
        strength = rng.uniform(0.2, 0.9) / np.sqrt(count)
        model.light_diffuse[number] = strength * rng.uniform(0.8, 1.0, 3)
        model.light_specular[number] = [rng.uniform(0.0, 0.5)] * 3
