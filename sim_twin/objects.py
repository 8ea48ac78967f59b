"""The things to grasp: shape, mass and friction, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from sim_twin.z1_mjcf import BIT_BASE, BIT_HAND, BIT_SCENE, CONTACT_SOLIMP, CONTACT_SOLREF, GROUP_SCENE

OBJECT_BODY = "object"

# Plastic or card on a melamine table: 0.3 to 0.5 in tables of friction. The jaws' rubber outranks it by priority.
_FRICTION = (0.4, 0.005, 0.0001)
_SEGMENTS = 48


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """One convex part of an object, in the object's frame: origin at mid-height on the axis, z up along it."""

    kind: str
    """"cylinder", "box" or "frustum"."""
    size_m: tuple[float, ...]
    """Cylinder: radius, half height. Box: three half edges. Frustum: lower radius, upper radius, half height."""
    z_m: float = 0.0
    """Height of the part's middle."""
    mass_kg: float
    """Share of the object's mass; with the shape it gives the inertia (homogeneous part)."""
    rgba: tuple[float, float, float, float]

    def corners(self) -> np.ndarray:
        """Return points (N, 3) [m] whose hull is the part."""
        if self.kind == "box":
            signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
            return signs * np.array(self.size_m) + [0, 0, self.z_m]
        low, high, half = (self.size_m[0], *self.size_m) if self.kind == "cylinder" else self.size_m
        angle = np.arange(_SEGMENTS) * 2 * np.pi / _SEGMENTS
        ring = np.column_stack([np.cos(angle), np.sin(angle)])
        return np.vstack(
            [
                np.column_stack([radius * ring, np.full(_SEGMENTS, z)])
                for radius, z in ((low, self.z_m - half), (high, self.z_m + half))
            ]
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspObject:
    """A rigid object made of convex parts."""

    height_m: float
    parts: tuple[Part, ...]

    @property
    def mass_kg(self) -> float:
        return sum(part.mass_kg for part in self.parts)

    def corners(self) -> np.ndarray:
        """Return points (N, 3) [m] in the object's frame that hold every extreme point of it."""
        return np.vstack([part.corners() for part in self.parts])


def lathe(profile: tuple[tuple[float, float], ...], parts: tuple[tuple[float, tuple], ...]) -> tuple[Part, ...]:
    """Return one part per segment of a profile of (height, radius) [m], heights from the foot.

    Args:
        profile: corner points, from the foot up.
        parts: (mass_kg, rgba) of each segment.
    """
    middle = profile[-1][0] / 2
    made = []
    for (z0, r0), (z1, r1), (mass_kg, rgba) in zip(profile[:-1], profile[1:], parts, strict=True):
        kind, size = ("cylinder", (r0, (z1 - z0) / 2)) if r0 == r1 else ("frustum", (r0, r1, (z1 - z0) / 2))
        made.append(Part(kind=kind, size_m=size, z_m=(z0 + z1) / 2 - middle, mass_kg=mass_kg, rgba=rgba))
    return tuple(made)


_BOTTLE_PROFILE = (
    (0.000, 0.030),
    (0.004, 0.033),
    (0.060, 0.033),
    (0.120, 0.033),
    (0.150, 0.033),
    (0.178, 0.013),
    (0.200, 0.013),
)
_PET, _LABEL, _CAP = (0.42, 0.66, 0.80, 1.0), (0.90, 0.92, 0.95, 1.0), (0.10, 0.28, 0.62, 1.0)

OBJECTS: dict[str, GraspObject] = {
    # A half-litre bottle, half full: 25 g of PET and 275 g of water, which stands 80 mm high (its share of the label's
    # part is spread over that part). The water is taken as frozen in place: at grasping accelerations its free surface
    # moves the centre of mass by a few millimetres.
    "bottle": GraspObject(
        height_m=0.200,
        parts=lathe(
            _BOTTLE_PROFILE,
            ((0.014, _PET), (0.199, _PET), (0.076, _LABEL), (0.005, _PET), (0.003, _PET), (0.003, _CAP)),
        ),
    ),
    # A pack of biscuits: card, 0.6 kg/l. Three different edges, so that no two faces can be mixed up. The 40 mm edge
    # lies across the view, along base y.
    "box": GraspObject(
        height_m=0.150,
        parts=(Part(kind="box", size_m=(0.035, 0.020, 0.075), mass_kg=0.25, rgba=(0.85, 0.50, 0.18, 1.0)),),
    ),
    # A filled tin of spice or crisps: 0.47 kg/l.
    "cylinder": GraspObject(
        height_m=0.150,
        parts=(Part(kind="cylinder", size_m=(0.030, 0.075), mass_kg=0.20, rgba=(0.75, 0.16, 0.16, 1.0)),),
    ),
}
OBJECT_NAMES = tuple(sorted(OBJECTS))


def add_object(spec: mujoco.MjSpec, name: str, T_base_object: np.ndarray) -> None:
    """Add the object as a free body called `object` at `T_base_object` (4, 4)."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, T_base_object[:3, :3].ravel().copy())
    body = spec.worldbody.add_body(name=OBJECT_BODY, pos=T_base_object[:3, 3], quat=quat)
    body.add_freejoint(name=OBJECT_BODY)
    for number, part in enumerate(OBJECTS[name].parts):
        geom = body.add_geom(
            name=f"{OBJECT_BODY}_{number}",
            group=GROUP_SCENE,
            mass=part.mass_kg,
            rgba=part.rgba,
            contype=BIT_SCENE,
            conaffinity=BIT_SCENE | BIT_BASE | BIT_HAND,
            condim=4,
            friction=_FRICTION,
            solref=CONTACT_SOLREF,
            solimp=CONTACT_SOLIMP,
        )
        if part.kind == "frustum":
            mesh = spec.add_mesh(name=f"{OBJECT_BODY}_{number}")
            mesh.uservert = part.corners().ravel()
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, mesh.name
            continue
        geom.type = mujoco.mjtGeom.mjGEOM_BOX if part.kind == "box" else mujoco.mjtGeom.mjGEOM_CYLINDER
        geom.size = [*part.size_m, *([0.0] * (3 - len(part.size_m)))]
        geom.pos = [0.0, 0.0, part.z_m]
