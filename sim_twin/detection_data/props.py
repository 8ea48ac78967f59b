"""Props of a detector's training images: the three classes in many proportions, and distractors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from hal.base.transforms import transform_points
from sim_twin.model.objects import OBJECTS
from sim_twin.model.parts import Part, make_lathe
from sim_twin.model.z1_mjcf import GROUP_SCENE

CLASSES = ("bottle", "box", "cylinder")
"""Classes of the detector, in the order of their label numbers."""
UNDRAWN_GROUP = 5
"""Geoms of this group are not drawn."""

_RGBA = (0.5, 0.5, 0.5, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Prop:
    """An object of a scene, made of convex parts in its own frame (origin at mid-height, z up)."""

    kind: str
    """One of `CLASSES`, or the kind of a distractor."""
    parts: tuple[tuple[Part, np.ndarray], ...]
    """Each part with its pose (4, 4) in the prop."""

    def corners(self) -> list[np.ndarray]:
        """Return for each part points (N, 3) [m] whose hull it is, in the prop's frame."""
        return [transform_points(pose, part.corners()) for part, pose in self.parts]


def nominal_prop(name: str) -> Prop:
    """Return the benchmark's own `name`."""
    return Prop(kind=name, parts=tuple((part, np.eye(4)) for part in OBJECTS[name].parts))


def make_class_prop(name: str, rng: np.random.Generator) -> Prop:
    """Return a bottle, a cylinder or a box of other proportions than the benchmark's.

    Boxes keep a shortest edge of 28 mm, cylinders are at least 1.7 times as high as wide: plates, discs and mugs,
    which are no objects of ours, stay apart from them.
    """
    if name == "box":
        edges = np.array([rng.uniform(0.028, 0.06), rng.uniform(0.05, 0.09), rng.uniform(0.09, 0.19)])
        half = edges[[*rng.permutation(2), 2]] / 2
        return _prop(name, _part("box", tuple(half)))
    if name == "cylinder":
        radius = rng.uniform(0.02, 0.04)
        return _prop(name, _part("cylinder", (radius, radius * rng.uniform(1.7, 4.0))))
    return _prop(name, *_make_bottle(rng))


def make_distractor(rng: np.random.Generator) -> Prop:
    """Return a distractor, of no class and of no shape like one: square to the lens, a plate is a box."""
    kind = list(_DISTRACTORS)[rng.integers(len(_DISTRACTORS))]
    return _DISTRACTORS[kind](rng)


def add_prop(spec: mujoco.MjSpec, prop: Prop, name: str) -> list[str]:
    """Add `prop` as a body called `name` that is placed by mocap and collides with nothing; return its geoms' names."""
    body = spec.worldbody.add_body(name=name, mocap=True)
    names = []
    for number, (part, pose) in enumerate(prop.parts):
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, pose[:3, :3].ravel().copy())
        names.append(f"{name}_{number}")
        geom = body.add_geom(
            name=names[-1], group=GROUP_SCENE, contype=0, conaffinity=0, rgba=part.rgba, pos=pose[:3, 3], quat=quat
        )
        if part.kind == "frustum":
            mesh = spec.add_mesh(name=names[-1])
            mesh.uservert = part.corners().ravel()
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, mesh.name
            continue
        geom.type = _PRIMITIVES[part.kind]
        geom.size = [*part.size_m, *([0.0] * (3 - len(part.size_m)))]
        geom.pos = pose[:3, :3] @ [0.0, 0.0, part.z_m] + pose[:3, 3]
    return names


_PRIMITIVES = {"box": mujoco.mjtGeom.mjGEOM_BOX, "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER} | {
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ellipsoid(Part):
    def corners(self) -> np.ndarray:
        v, u = np.meshgrid(np.linspace(0, np.pi, 9), np.linspace(0, 2 * np.pi, 16, endpoint=False))
        ball = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).reshape(-1, 3)
        return ball * np.array(self.size_m) + [0, 0, self.z_m]


def _part(kind: str, size_m: tuple[float, ...]) -> Part:
    made = _Ellipsoid if kind == "ellipsoid" else Part
    return made(kind=kind, size_m=size_m, mass_kg=0.1, rgba=_RGBA)


def _prop(kind: str, *parts: Part, poses: list[np.ndarray] | None = None) -> Prop:
    return Prop(kind=kind, parts=tuple(zip(parts, poses or [np.eye(4)] * len(parts), strict=True)))


def _at(x: float = 0.0, y: float = 0.0, z: float = 0.0, about: int = 0, angle: float = 0.0) -> np.ndarray:
    """Pose at (x, y, z), turned by `angle` about axis number `about`."""
    pose = np.eye(4)
    i, j = [k for k in range(3) if k != about]
    pose[[i, i, j, j], [i, j, i, j]] = [np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)]
    pose[:3, 3] = [x, y, z]
    return pose


def _make_bottle(rng: np.random.Generator) -> tuple[Part, ...]:
    """Foot, body, label, body, shoulder, neck and cap."""
    radius, height = rng.uniform(0.024, 0.042), rng.uniform(0.15, 0.26)
    neck = rng.uniform(0.28, 0.48) * radius
    shoulder, collar = rng.uniform(0.58, 0.76), rng.uniform(0.82, 0.90)
    label = sorted(rng.uniform(0.15, 0.55, 2))
    # A part needs a height: the profile must rise from point to point
    end = min(max(label[1], label[0] + 0.05), shoulder - 0.005)
    heights = [0.0, 0.02, label[0], end, shoulder, collar, rng.uniform(0.92, 0.95), 1.0]
    cap = neck * rng.uniform(1.0, 1.25)
    radii = [0.92 * radius, radius, radius, radius, radius, neck, neck, cap]
    profile = tuple((height * h, float(r)) for h, r in zip(heights, radii, strict=True))
    return make_lathe(profile, ((0.05, _RGBA),) * 7)


def _make_ball(rng: np.random.Generator) -> Prop:
    return _prop("ball", _part("ellipsoid", (rng.uniform(0.015, 0.05),) * 3))


def _make_egg(rng: np.random.Generator) -> Prop:
    flat = rng.uniform(0.02, 0.06, 2)
    return _prop("egg", _part("ellipsoid", (flat[0], flat[0] * rng.uniform(0.8, 1.2), min(flat[1], 1.6 * flat[0]))))


def _make_cone(rng: np.random.Generator) -> Prop:
    radius = rng.uniform(0.03, 0.06)
    return _prop("cone", _part("frustum", (radius, rng.uniform(0.002, 0.2 * radius), rng.uniform(0.03, 0.09))))


def _make_disc(rng: np.random.Generator) -> Prop:
    radius = rng.uniform(0.03, 0.09)
    return _prop("disc", _part("cylinder", (radius, rng.uniform(0.03, 0.2) * radius)))


def _make_stick(rng: np.random.Generator) -> Prop:
    return _prop("stick", _part("cylinder", (rng.uniform(0.003, 0.006), rng.uniform(0.06, 0.14))))


def _make_angle(rng: np.random.Generator) -> Prop:
    """An L, a T or a cross of two bars."""
    long, short, half = rng.uniform(0.05, 0.09), rng.uniform(0.025, 0.05), rng.uniform(0.005, 0.009)
    across = _part("box", (short, half, half))
    up = _part("box", (half, half, long))
    side, height = [(short - half, -long + half), (0.0, long - half), (0.0, 0.3 * long)][rng.integers(3)]
    return _prop("angle", up, across, poses=[np.eye(4), _at(x=side, z=height)])


def _make_mug(rng: np.random.Generator) -> Prop:
    radius = rng.uniform(0.036, 0.048)
    half = radius * rng.uniform(0.65, 0.95)
    grip, thick = rng.uniform(0.019, 0.027), rng.uniform(0.004, 0.007)
    hollow = replace(_part("cylinder", (0.9 * radius, 0.001)), z_m=half)
    parts, poses = [_part("cylinder", (radius, half)), hollow], [np.eye(4), np.eye(4)]
    for angle in np.linspace(-0.5 * np.pi, 0.5 * np.pi, 7):
        parts.append(_part("box", (thick, thick, 0.30 * grip)))
        poses.append(_at(x=radius + grip * np.cos(angle), z=grip * np.sin(angle), about=1, angle=-angle))
    return _prop("mug", *parts, poses=poses)


def _make_ring(rng: np.random.Generator) -> Prop:
    radius, thick, n = rng.uniform(0.025, 0.06), rng.uniform(0.005, 0.012), 14
    # Longer than an nth of the circle by a third: pointed ends overlap, and the ring has no gaps
    piece = _part("ellipsoid", (thick, 1.35 * np.pi * radius / n, thick))
    turns = [2 * np.pi * k / n for k in range(n)]
    poses = [_at(x=radius * np.cos(a), y=radius * np.sin(a), about=2, angle=a) for a in turns]
    return _prop("ring", *[piece] * n, poses=poses)


_DISTRACTORS: dict[str, Callable[[np.random.Generator], Prop]] = {
    "ball": _make_ball,
    "egg": _make_egg,
    "cone": _make_cone,
    "disc": _make_disc,
    "stick": _make_stick,
    "angle": _make_angle,
    "mug": _make_mug,
    "ring": _make_ring,
}
