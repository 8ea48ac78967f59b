"""Convex parts of an object, and functions that make many of them at once."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np

# A polygon of 48 sides is 0.2 % of the radius inside its circle: 0.07 mm at the bottle's 33 mm
_SEGMENTS = 48
# Each stave is a geom with contacts of its own, so a wall has fewer sides than a hull
_WALL_SEGMENTS = 16

Rgba = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """One convex part of an object, in the object's frame: origin at mid-height on the axis, z up along it."""

    kind: str
    """"cylinder", "box", "frustum" or "hull"."""
    size_m: tuple[float, ...]
    """Cylinder: radius, half height. Box: three half edges. Frustum: lower radius, upper radius, half height.
    Hull: x, y, z of each corner in turn."""
    z_m: float = 0.0
    """Height of the part's middle."""
    xy_m: tuple[float, float] = (0.0, 0.0)
    """Offset of its middle from the object's axis."""
    mass_kg: float
    """Mass; with the shape it gives the inertia (homogeneous part)."""
    rgba: Rgba

    @property
    def middle_m(self) -> np.ndarray:
        """The part's middle (3,) in the object's frame [m]."""
        return np.array([*self.xy_m, self.z_m])

    def corners(self) -> np.ndarray:
        """Return points (N, 3) [m] whose hull is the part."""
        return self._own_corners() + self.middle_m

    def _own_corners(self) -> np.ndarray:
        if self.kind == "hull":
            return np.reshape(self.size_m, (-1, 3))
        if self.kind == "box":
            signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
            return signs * np.array(self.size_m)
        low, high, half = (self.size_m[0], *self.size_m) if self.kind == "cylinder" else self.size_m
        ring = _ring(_SEGMENTS)
        return np.vstack(
            [np.column_stack([radius * ring, np.full(len(ring), z)]) for radius, z in ((low, -half), (high, half))]
        )

    def shape(self, spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> None:
        """Give `geom` of `spec`, which has a name, the part's shape and place in the object's frame."""
        if self.kind in ("frustum", "hull"):
            mesh = spec.add_mesh(name=geom.name)
            # MuJoCo makes the convex hull of a mesh that has vertices and no faces
            mesh.uservert = self.corners().ravel()
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, mesh.name
            return
        geom.type = mujoco.mjtGeom.mjGEOM_BOX if self.kind == "box" else mujoco.mjtGeom.mjGEOM_CYLINDER
        # MuJoCo takes three numbers for every type of geom
        geom.size = [*self.size_m, *([0.0] * (3 - len(self.size_m)))]
        geom.pos = self.middle_m


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspObject:
    """A rigid object made of convex parts."""

    height_m: float
    parts: tuple[Part, ...]
    is_stable: bool = True
    """Stable upright; an unstable object is held by a break-away fixture in every pose."""

    @property
    def mass_kg(self) -> float:
        return sum(part.mass_kg for part in self.parts)

    def corners(self) -> np.ndarray:
        """Return points (N, 3) [m] in the object's frame that hold every extreme point of it."""
        return np.vstack([part.corners() for part in self.parts])


def make_lathe(profile: tuple[tuple[float, float], ...], parts: tuple[tuple[float, tuple], ...]) -> tuple[Part, ...]:
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


def make_homogeneous_lathe(profile: tuple[tuple[float, float], ...], mass_kg: float, rgba: Rgba) -> tuple[Part, ...]:
    """Return the parts of a `make_lathe` profile of one material: masses in proportion to volumes."""
    # Of frustums, without the common factor π/3
    volumes = np.array([(z1 - z0) * (r0 * r0 + r0 * r1 + r1 * r1) for (z0, r0), (z1, r1) in pairwise(profile)])
    return make_lathe(profile, tuple((float(mass), rgba) for mass in mass_kg * volumes / volumes.sum()))


def make_wall(
    low: tuple[float, float], high: tuple[float, float], z_m: tuple[float, float], mass_kg: float, rgba: Rgba
) -> tuple[Part, ...]:
    """Return a round wall open above and below, as staves with no gaps between them.

    Args:
        low: inner and outer radius at its foot [m].
        high: the same at its rim.
        z_m: heights of foot and rim in the object's frame [m].
        mass_kg: of the whole wall.
        rgba: its colour.
    """
    ring = _ring(_WALL_SEGMENTS)
    staves = []
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        corners = [
            (radius * x, radius * y, z)
            for radii, z in zip((low, high), z_m, strict=True)
            for radius in radii
            for x, y in (a, b)
        ]
        size = tuple(float(value) for corner in corners for value in corner)
        staves.append(Part(kind="hull", size_m=size, mass_kg=mass_kg / _WALL_SEGMENTS, rgba=rgba))
    return tuple(staves)


def _ring(segments: int) -> np.ndarray:
    """Return the corners (segments, 2) of a regular polygon in the unit circle."""
    angle = np.arange(segments) * 2 * np.pi / segments
    return np.column_stack([np.cos(angle), np.sin(angle)])
