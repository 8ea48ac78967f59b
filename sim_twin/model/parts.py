"""Convex parts: of objects, and of the Z1's links, whose meshes are cut by planes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from hal.base import z1
from hal.base.z1 import T_PIVOT_STATIONARY_JAW

if TYPE_CHECKING:
    import trimesh


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
    for (low, r0), (high, r1), (mass_kg, rgba) in zip(profile[:-1], profile[1:], parts, strict=True):
        half = (high - low) / 2
        kind, size = ("cylinder", (r0, half)) if r0 == r1 else ("frustum", (r0, r1, half))
        made.append(Part(kind=kind, size_m=size, z_m=(low + high) / 2 - middle, mass_kg=mass_kg, rgba=rgba))
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


JAW_LINKS = ("gripperStator", "gripperMover")
_PIVOT_IN_STATOR_M = -float(T_PIVOT_STATIONARY_JAW[0, 3])
# Corners are rounded to a grid, which leaves far fewer of them: 0.1 mm of error at the jaws, 1 mm at the links.
_JAW_GRID_M, _LINK_GRID_M = 2e-4, 2e-3
_VISUAL_GRID_M = 8e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class Region:
    """A box in the link's frame; the part of the mesh inside becomes one convex piece."""

    x: tuple[float, float] = (-1.0, 1.0)
    y: tuple[float, float] = (-1.0, 1.0)
    z: tuple[float, float] = (-1.0, 1.0)


def _slabs(*edges: float, offset: float = 0.0, **other: tuple[float, float]) -> tuple[Region, ...]:
    return tuple(Region(x=(low + offset, high + offset), **other) for low, high in pairwise(edges))


# Along x of the pivot frame. The inner faces of both jaws are prisms in y: a hollow from 34 to 74.5 mm, then a flat
# pad to the tip at 100 mm; cut like this no hull bulges into the opening by more than 0.6 mm.
_FINGER = (0.034, 0.046, 0.052, 0.058, 0.066, 0.0745, 0.1001)
_IN_STATOR = _PIVOT_IN_STATOR_M

LINK_PIECES: dict[str, tuple[Region, ...]] = {
    "link00": (Region(),),
    "link01": (Region(),),
    "link02": _slabs(-0.39, -0.31, -0.04, 0.04),
    "link03": _slabs(-0.04, 0.03, 0.07, 0.19, 0.26),
    "link04": _slabs(-0.04, 0.035, 0.11),
    "link05": (Region(),),
    "link06": (Region(),),
    "gripperStator": (
        Region(x=(-0.01, 0.0155 + _IN_STATOR)),
        Region(x=(0.0155 + _IN_STATOR, 0.034 + _IN_STATOR), z=(-0.0165, 0.04)),
        Region(x=(0.0155 + _IN_STATOR, 0.034 + _IN_STATOR), z=(-0.04, -0.0165)),
        *_slabs(*_FINGER, offset=_IN_STATOR, z=(-0.04, -0.008)),
    ),
    "gripperMover": (
        Region(x=(-0.03, 0.034), y=(-0.05, -0.027)),
        Region(x=(-0.03, 0.034), y=(0.027, 0.05)),
        Region(x=(0.015, 0.034), z=(0.0165, 0.03)),
        *_slabs(*_FINGER),
    ),
}


@cache
def load_link_mesh(link: str) -> trimesh.Trimesh:
    """Return the collision mesh of a URDF link in the link's frame [m].

    Raises:
        FileNotFoundError: the wheel with the description is not installed.
    """
    import trimesh

    return trimesh.load_mesh(z1.mesh_dir() / "collision" / f"z1_{link[0].upper()}{link[1:]}.STL")


@cache
def load_visual_mesh(link: str) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) [m] and faces (F, 3) of a link for rendering: the mesh without its finest fillets."""
    mesh = load_link_mesh(link)
    cells = np.round(mesh.vertices / _VISUAL_GRID_M).astype(np.int64)
    _, first, cell_of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    faces = cell_of.reshape(-1)[mesh.faces]
    # Triangles with two corners in one cell have no area left
    flat = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return np.asarray(mesh.vertices)[first], faces[~flat]


@cache
def split_convex(link: str) -> tuple[np.ndarray, ...]:
    """Return the corners (M, 3) [m] of each convex piece of a link, in the link's frame."""
    mesh, grid_m = load_link_mesh(link), _JAW_GRID_M if link in JAW_LINKS else _LINK_GRID_M
    return tuple(_hull_corners(_clip(mesh, region), grid_m) for region in LINK_PIECES[link])


def _clip(mesh: trimesh.Trimesh, region: Region) -> np.ndarray:
    """Return points (M, 3) of the surface inside the region, with those where it meets the region's planes."""
    import trimesh

    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    for axis, (low, high) in enumerate((region.x, region.y, region.z)):
        for bound, sign in ((low, 1.0), (high, -1.0)):
            normal = sign * np.eye(3)[axis]
            if (sign * (vertices[:, axis] - bound)).min() < 0:
                vertices, faces, _ = trimesh.intersections.slice_faces_plane(
                    vertices, faces, normal, bound * np.eye(3)[axis]
                )
                # Vertices that were cut off stay in the list, and would count in the hull
                used, inverse = np.unique(faces, return_inverse=True)
                vertices, faces = vertices[used], inverse.reshape(-1, 3)
    return vertices


def _hull_corners(points: np.ndarray, grid_m: float) -> np.ndarray:
    from scipy.spatial import ConvexHull

    coarse = np.unique(np.round(points / grid_m).astype(np.int64), axis=0) * grid_m
    return coarse[ConvexHull(coarse).vertices]
