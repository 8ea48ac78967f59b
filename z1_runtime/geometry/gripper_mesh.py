"""Surface points of gripper, camera and bracket for collision tests (links: `hal.base.z1_shape`)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from hal.base import z1
from hal.base.transforms import transform_points
from hal.base.z1_shape import PALM_RADIUS_M, T_PIVOT_STATIONARY_JAW

_SPACING_M = 0.0085
_JAW_SPACING_M = 0.005  # jaws pass the object within millimetres, and its edges must not fit between two points


@dataclass(frozen=True, slots=True, eq=False)
class GripperShape:
    """Even surface points of everything on the wrist, in an order of which every head is spread over the whole."""

    fixed: np.ndarray
    """(V, 3) wrist, stationary jaw, camera and bracket, in the pivot frame [m]."""
    moving_jaw: np.ndarray
    """(V, 3) moving jaw, in its own frame: the pivot frame at jaw angle 0 [m]."""

    def __len__(self) -> int:
        return len(self.fixed) + len(self.moving_jaw)


@cache
def gripper_shape(spacing_m: float = _SPACING_M) -> GripperShape:
    """Return the points, sampled from the STL meshes about `spacing_m` apart [m], closer on the jaws."""
    T_pivot_flange = np.linalg.inv(z1.T_FLANGE_PIVOT)
    stator = transform_points(T_PIVOT_STATIONARY_JAW, _mesh_surface("z1_GripperStator", spacing_m))
    jaw = transform_points(T_PIVOT_STATIONARY_JAW, _mesh_surface("z1_GripperStator", _JAW_SPACING_M))
    stator = np.concatenate([stator[stator[:, 0] < PALM_RADIUS_M], jaw[jaw[:, 0] >= PALM_RADIUS_M]])
    # The housing is hollow; nothing gets inside without crossing its surface
    inside = (np.hypot(stator[:, 0], stator[:, 2]) < PALM_RADIUS_M - 0.002) & (np.abs(stator[:, 1]) < 0.026)
    wrist = transform_points(T_pivot_flange, _mesh_surface("z1_Link06", spacing_m))
    camera = transform_points(
        T_pivot_flange @ z1.T_FLANGE_CAMERA, _box_surface(z1.CAMERA_HOUSING_LOW, z1.CAMERA_HOUSING_HIGH, spacing_m)
    )
    bracket = transform_points(T_pivot_flange, _bracket(spacing_m))
    fixed = np.concatenate([stator[~inside], wrist, camera, bracket])
    moving_jaw = _mesh_surface("z1_GripperMover", _JAW_SPACING_M)
    shape = GripperShape(fixed=spread_first(fixed), moving_jaw=spread_first(moving_jaw))
    # The cache gives the same arrays to every caller
    shape.fixed.setflags(write=False)
    shape.moving_jaw.setflags(write=False)
    return shape


def spread_first(vertices: np.ndarray) -> np.ndarray:
    """Return `vertices` (V, 3) reordered so that any head of the list is spread over the whole: hits come early."""
    # Seeded: which point is hit first is part of a rejection's text
    order = np.random.default_rng(0).permutation(len(vertices))
    return vertices[order]


def _mesh_surface(name: str, spacing_m: float) -> np.ndarray:
    """Return surface points of a mesh: many random ones, thinned to one per voxel (the one nearest its middle)."""
    import trimesh

    mesh = trimesh.load_mesh(z1.mesh_dir() / "collision" / f"{name}.STL")
    # 40 samples for each face of a voxel leave hardly any voxel of the surface empty
    n_dense = int(40.0 * mesh.area / spacing_m**2)
    dense = np.asarray(trimesh.sample.sample_surface(mesh, n_dense, seed=0)[0])
    return _thinned(dense, spacing_m)


def _thinned(dense: np.ndarray, spacing_m: float) -> np.ndarray:
    voxel = np.floor(dense / spacing_m)
    off_centre = np.sum((dense / spacing_m - voxel - 0.5) ** 2, axis=1)
    order = np.argsort(off_centre, kind="stable")
    _, first = np.unique(voxel[order], axis=0, return_index=True)
    return dense[order[first]]


def _box_surface(low: np.ndarray, high: np.ndarray, spacing_m: float) -> np.ndarray:
    """Return a grid over the six faces of an axis-aligned box."""
    counts = np.maximum(np.ceil((high - low) / spacing_m).astype(int) + 1, 2)
    axes = [np.linspace(low[a], high[a], counts[a]) for a in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    on_surface = (np.isclose(grid, low) | np.isclose(grid, high)).any(axis=1)
    return grid[on_surface]


def _bracket(spacing_m: float) -> np.ndarray:
    """Return a grid over the plate between wrist and camera, in the flange frame."""
    rise, half_width = z1.BRACKET_HEAD - z1.BRACKET_FOOT, z1.BRACKET_HALF_WIDTH_M
    along = np.linspace(0.0, 1.0, int(np.ceil(np.linalg.norm(rise) / spacing_m)) + 1)[:, None, None]
    across = np.linspace(-half_width, half_width, int(np.ceil(2.0 * half_width / spacing_m)) + 1)[None, :, None]
    return (z1.BRACKET_FOOT + along * rise + across * np.array([0.0, 0.0, 1.0])).reshape(-1, 3)
