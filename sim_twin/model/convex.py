"""Convex pieces of the Z1's links: the STL cut by planes, each part replaced by its hull."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from hal.base import z1
from hal.base.z1_shape import T_PIVOT_STATIONARY_JAW

if TYPE_CHECKING:  # trimesh takes two seconds to import, and a scene's description needs none of it
    import trimesh

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
