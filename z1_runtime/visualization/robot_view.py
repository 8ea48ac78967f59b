"""The Z1 in Rerun: one mesh per link, logged once, and the links' poses with every arm state."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np
import rerun as rr
import trimesh

from hal.base import z1
from hal.base.z1_model import ForwardKinematics
from z1_runtime.visualization import blueprint

Drawing = Iterator[tuple[str, rr.AsComponents]]

LINKS = ("link00", "link01", "link02", "link03", "link04", "link05", "link06", "gripperStator", "gripperMover")
"""The URDF's links that have a mesh, all with the link's frame as its origin."""
_MESH_GRID_M = 0.002
"""Vertices within one cell of this grid are merged: 12 MB of STL become 1.5 MB, and a viewer shows no difference."""
_LINK_COLOUR = (150, 170, 190)
_JAW_COLOUR = (70, 80, 95)


class RobotView:
    """Entities of the arm and gripper; one object belongs to one thread, as `ForwardKinematics` does.

    `rerun.urdf.UrdfTree` would log the Collada meshes, 20 MB of files that it finds by ROS_PACKAGE_PATH only.
    """

    def __init__(self) -> None:
        self._kinematics = ForwardKinematics()

    def draw_links(self) -> Drawing:
        """Yield the links' meshes, each in its link's frame."""
        for link in LINKS:
            yield f"{blueprint.ARM}/{link}", _load_mesh(link)

    def draw_pose(self, q: np.ndarray) -> Drawing:
        """Yield the links' poses at joint positions `q` (7,) [rad]."""
        poses = self._kinematics.link_poses(q)
        for link in LINKS:
            T_base_link = poses[link]
            yield (
                f"{blueprint.ARM}/{link}",
                rr.Transform3D(translation=T_base_link[:3, 3], mat3x3=T_base_link[:3, :3]),
            )

    def pivot_path(self, q: np.ndarray) -> np.ndarray:
        """Return the positions of the gripper's pivot in base, (N, 3) [m], at joint positions `q` (N, 7) [rad]."""
        return np.array([self._kinematics.pivot(row[: z1.N_ARM])[:3, 3] for row in q]).reshape(-1, 3)


@cache
def _load_mesh(link: str) -> rr.Mesh3D:
    """Return a link's collision mesh, the STL twin of its visual one, with the vertices of one grid cell merged."""
    mesh = trimesh.load_mesh(z1.mesh_dir() / "collision" / f"z1_{link[0].upper()}{link[1:]}.STL")
    # merge_vertices rounds to decimal digits, so the grid is made the unit of length
    mesh.apply_scale(1.0 / _MESH_GRID_M)
    mesh.merge_vertices(digits_vertex=0)
    mesh.apply_scale(_MESH_GRID_M)
    a, b, c = mesh.faces.T
    # A triangle with two corners in one cell has no area left
    mesh.update_faces((a != b) & (b != c) & (c != a))
    return rr.Mesh3D(
        vertex_positions=mesh.vertices.astype(np.float32),
        triangle_indices=mesh.faces.astype(np.uint32),
        vertex_normals=mesh.vertex_normals.astype(np.float32),
        albedo_factor=_JAW_COLOUR if link.startswith("gripper") else _LINK_COLOUR,
    )
