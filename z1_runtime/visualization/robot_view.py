"""The Z1 as Rerun draws it: link meshes once, joint transforms with every arm state, read from the URDF."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from hal.base import z1
from z1_runtime.visualization import blueprint

Drawing = Iterator[tuple[str, rr.AsComponents]]

_GRID_M = 0.002
"""Mesh vertices nearer than this are merged: 12 MB of STL become about 1 MB, and look the same."""
_STL_HEADER_BYTES = 84
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_LINK_COLOUR = (150, 170, 190)
_JAW_COLOUR = (70, 80, 95)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Joint:
    """One joint of the chain, in the order of the tree."""

    parent: str
    child: str
    T_parent_joint: np.ndarray
    axis: np.ndarray
    index: int | None
    """Place in a joint vector; None when fixed."""


class RobotDrawing:
    """Draws the arm and places its pivot, without any kinematics library."""

    def __init__(self) -> None:
        tree = ElementTree.parse(z1.urdf_path()).getroot()
        self._joints = [_read_joint(element) for element in tree.findall("joint")]
        self._meshes = dict(_read_meshes(tree))
        root = self._joints[0].parent
        self._paths = {root: blueprint.ARM}
        for joint in self._joints:
            self._paths[joint.child] = f"{self._paths[joint.parent]}/{joint.child}"

    def draw_links(self) -> Drawing:
        """Yield what never changes: the meshes, and the transforms of the fixed joints."""
        for joint in self._joints:
            if joint.index is None:
                yield self._paths[joint.child], _transform(joint.T_parent_joint)
        for link, (T_link_mesh, path) in self._meshes.items():
            place = f"{self._paths[link]}/mesh"
            yield place, _transform(T_link_mesh)
            yield place, _read_mesh(path, _JAW_COLOUR if link.startswith("gripper") else _LINK_COLOUR)

    def draw_pose(self, q: np.ndarray) -> Drawing:
        """Yield the transform of every joint that turns, at joint positions `q` (7,) [rad]."""
        for joint in self._joints:
            if joint.index is not None:
                yield self._paths[joint.child], _transform(_joint_pose(joint, q[joint.index]))

    def pivot_path(self, q: np.ndarray) -> np.ndarray:
        """Return where the gripper's pivot is in base, (N, 3) [m], at joint positions `q` (N, 7) [rad]."""
        return np.array([self._pivot(row) for row in q]).reshape(-1, 3)

    def _pivot(self, q: np.ndarray) -> np.ndarray:
        T_base_flange = np.eye(4)
        for joint in self._joints:
            if joint.index is not None and joint.index < z1.N_ARM:
                T_base_flange = T_base_flange @ _joint_pose(joint, q[joint.index])
        return (T_base_flange @ z1.T_FLANGE_PIVOT)[:3, 3]


def _read_joint(element: ElementTree.Element) -> _Joint:
    names = [f"joint{i + 1}" for i in range(z1.N_ARM)] + ["jointGripper"]
    name = element.attrib["name"]
    return _Joint(
        parent=element.find("parent").attrib["link"],  # pyright: ignore[reportOptionalMemberAccess]
        child=element.find("child").attrib["link"],  # pyright: ignore[reportOptionalMemberAccess]
        T_parent_joint=_read_origin(element.find("origin")),
        axis=_read_vector(element.find("axis"), "xyz", "1 0 0"),
        index=names.index(name) if name in names else None,
    )


def _read_meshes(tree: ElementTree.Element) -> Iterator[tuple[str, tuple[np.ndarray, Path]]]:
    """Yield each link's mesh: Rerun shows the visual ones (Collada) slowly, so their STL twins are taken."""
    for link in tree.findall("link"):
        visual = link.find("visual")
        mesh = None if visual is None else visual.find("geometry/mesh")
        if visual is not None and mesh is not None:
            path = z1.mesh_dir() / "collision" / f"{Path(mesh.attrib['filename']).stem}.STL"
            yield link.attrib["name"], (_read_origin(visual.find("origin")), path)


def _read_vector(element: ElementTree.Element | None, key: str, default: str) -> np.ndarray:
    return np.array((default if element is None else element.attrib.get(key, default)).split(), dtype=float)


def _read_origin(element: ElementTree.Element | None) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", _read_vector(element, "rpy", "0 0 0")).as_matrix()
    T[:3, 3] = _read_vector(element, "xyz", "0 0 0")
    return T


def _joint_pose(joint: _Joint, angle: float) -> np.ndarray:
    T = joint.T_parent_joint.copy()
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(joint.axis * angle).as_matrix()
    return T


def _transform(T: np.ndarray) -> rr.Transform3D:
    return rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])


@cache
def _read_mesh(path: Path, colour: tuple[int, int, int]) -> rr.Mesh3D:
    """Return a binary STL as an indexed mesh whose near vertices are merged."""
    corners = np.fromfile(path, dtype=_STL_TRIANGLE, offset=_STL_HEADER_BYTES)["corners"].reshape(-1, 3)
    cells = np.round((corners - corners.min(axis=0)) / _GRID_M).astype(np.int64)
    _, first, merged = np.unique(cells @ (1, 1 << 20, 1 << 40), return_index=True, return_inverse=True)
    vertices, faces = corners[first], merged.reshape(-1, 3)
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    edges = vertices[faces]
    normals = np.zeros_like(vertices)
    weighted = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])  # longer for larger triangles
    for corner in faces.T:
        np.add.at(normals, corner, weighted)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return rr.Mesh3D(
        vertex_positions=vertices,
        triangle_indices=faces.astype(np.uint32),
        vertex_normals=normals,
        albedo_factor=colour,
    )
