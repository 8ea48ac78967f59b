"""A user's mesh as a graspable object: parsed, checked for its size, decomposed by CoACD, cached on disk."""

from __future__ import annotations

import hashlib
import os
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from hal.base.errors import Z1Error
from hal.base.files import atomic_path
from sim_twin.model.objects import OBJECT_BODY, add_object
from sim_twin.model.parts import GraspObject, Part
from sim_twin.model.z1_mjcf import BIT_SCENE

if TYPE_CHECKING:  # trimesh takes two seconds to import
    import trimesh

SUFFIXES = (".stl", ".obj", ".ply", ".off", ".glb")
SIZE_M = (0.02, 0.35)
"""Minimum and maximum of the longest edge of a mesh's bounding box [m]: the range that fits gripper and table."""
MASS_KG = (0.001, 2.0)
"""Minimum and maximum mass [kg]; the Z1's payload is 2 kg."""
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "metres": 1.0}
# Concavities deeper than 5 % of the size are kept, in up to 32 parts of up to 64 corners: physics stays quick.
_COACD = {"threshold": 0.05, "max_convex_hull": 32, "decimate": True, "max_ch_vertex": 64, "seed": 0}
# Open meshes are decomposed as they are, which fills them: CoACD's own thickening keeps a vessel hollow, but makes so
# many triangles of it that the decomposition takes many minutes.
_COACD_OPEN = {"preprocess_mode": "off", "resolution": 1000, "mcts_iterations": 60}
_RGBA = (0.36, 0.52, 0.62, 1.0)
_PUT_DOWN_RAD, _UPRIGHT_RAD, _TRIAL_STEP_S = float(np.deg2rad(2.0)), float(np.deg2rad(6.0)), 1e-3
_FOOT_HEIGHT_M = 1.5e-3
"""Corners this little above the lowest one count as feet: meshes are seldom quite level."""


class MeshError(Z1Error, ValueError):
    """A mesh that cannot be grasped; the message has the value found and the remedy."""

    default_code = "mesh"


def load_mesh_object(path: Path, scale: float, mass_kg: float) -> tuple[str, GraspObject]:
    """Return a mesh file as an object, and a name for it that no other mesh, scale or mass has.

    Args:
        path: STL, OBJ, PLY, OFF or GLB, z up; watertight or not, but walls without thickness come out filled.
        scale: metres in one of the file's units.
        mass_kg: of the whole, spread evenly over the parts' volumes.

    Raises:
        MeshError: it is missing or no mesh, or its size or mass is out of range.
    """
    if not (MASS_KG[0] <= mass_kg <= MASS_KG[1]):
        raise MeshError(
            f"mesh: --mass is out of range ({mass_kg:g} kg, allowed {MASS_KG[0]:g} to {MASS_KG[1]:g} kg). Give the "
            "object's mass in kilograms.",
            code="mesh_mass",
        )
    content = _read(path)
    mesh = _parse(path, content)
    _check_size(path, np.ptp(mesh.vertices, axis=0), scale)
    hulls = [scale * corners for corners in _decompose(mesh, content)]
    name = f"{path.stem}-{hashlib.sha256(content + repr((scale, mass_kg)).encode()).hexdigest()[:8]}"
    return name, _assemble(path, hulls, mass_kg)


def cache_folder() -> Path:
    """Return where decompositions are kept: z1-grasp/convex in $XDG_CACHE_HOME, else in ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "z1-grasp" / "convex"


def _read(path: Path) -> bytes:
    if path.suffix.lower() not in SUFFIXES:
        raise MeshError(
            f"mesh: the file type of {path} is unknown ({path.suffix!r}, allowed {', '.join(SUFFIXES)}). Convert it.",
            code="mesh_suffix",
        )
    try:
        return path.read_bytes()
    except OSError as error:
        raise MeshError(
            f"mesh: {path} cannot be read ({error.strerror}). Check the path.", code="mesh_unreadable"
        ) from error


def _parse(path: Path, content: bytes) -> trimesh.Trimesh:
    import trimesh

    try:
        # Of an OBJ only the shape counts: its materials would be searched in other files
        mesh = trimesh.load(
            trimesh.util.wrap_as_stream(content),
            file_type=path.suffix[1:].lower(),
            force="mesh",
            skip_materials=True,
        )
    except Exception as error:  # readers of six formats fail in as many ways
        raise MeshError(
            f"mesh: {path} cannot be parsed as {path.suffix[1:].upper()} ({error}). Export it again.",
            code="mesh_format",
        ) from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise MeshError(
            f"mesh: {path} has no triangles (0 faces, allowed 1 or more). Export a mesh, not a cloud of points or "
            "lines.",
            code="mesh_no_faces",
        )
    if not np.isfinite(mesh.vertices).all():
        raise MeshError(f"mesh: {path} has vertices that are not finite. Export it again.", code="mesh_not_finite")
    return mesh


def _check_size(path: Path, extents: np.ndarray, scale: float) -> None:
    """Reject a mesh whose size at `scale` cannot be grasped, and suggest scales that fit."""
    low, high = SIZE_M
    if not (np.isfinite(scale) and scale > 0):
        raise MeshError(
            f"mesh: --scale is invalid ({scale:g}, allowed above 0). Give the metres in one of the file's units.",
            code="mesh_scale",
        )
    longest = float(extents.max())
    if low <= scale * longest <= high:
        return
    size = " × ".join(f"{value:.4g}" for value in scale * extents)
    fitting = [f"--scale {unit:g} if it is in {name}" for name, unit in _UNITS.items() if low <= unit * longest <= high]
    advice = f"Give {', or '.join(fitting)}." if fitting else "No usual unit makes it fit; give the --scale that does."
    raise MeshError(
        f"mesh: the size of {path} is out of range ({size} m with --scale {scale:g}, allowed {low:g} to {high:g} m for "
        f"the longest edge). {advice}",
        code="mesh_size",
    )


def _decompose(mesh: trimesh.Trimesh, content: bytes) -> list[np.ndarray]:
    """Return the corners (M, 3) of convex parts that together are the mesh, in the file's units; cached by content."""
    # In the key, as other settings give other parts of the same mesh
    settings = repr((version("coacd"), _COACD, _COACD_OPEN)).encode()
    path = cache_folder() / f"{hashlib.sha256(settings + content).hexdigest()}.npz"
    if path.exists():
        with np.load(path) as stored:
            return [stored[key] for key in stored.files]
    import coacd

    mesh.fill_holes()  # the small ones
    more = {} if mesh.is_watertight else _COACD_OPEN
    coacd.set_log_level("error")
    parts = coacd.run_coacd(coacd.Mesh(mesh.vertices, mesh.faces), **_COACD, **more)
    hulls = [np.asarray(vertices, dtype=np.float64) for vertices, _ in parts]
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **{f"hull_{k:02}": hull for k, hull in enumerate(hulls)})
    return hulls


def _assemble(path: Path, hulls: list[np.ndarray], mass_kg: float) -> GraspObject:
    """Return the object whose origin is the middle of its bounding box."""
    corners = np.vstack(hulls)
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    bodies = [_hull(hull - middle) for hull in hulls]
    bodies = [body for body in bodies if body is not None]
    if not bodies:
        raise MeshError(
            f"mesh: {path} is flat (0 parts with a volume, allowed 1 or more). Give it a thickness.", code="mesh_flat"
        )
    # CoACD cuts by planes: its parts hardly overlap, so that their volumes add up
    total = sum(body.volume for body in bodies)
    parts = tuple(
        Part(
            kind="hull",
            size_m=tuple(float(value) for value in body.points[body.vertices].ravel()),
            mass_kg=mass_kg * body.volume / total,
            rgba=_RGBA,
        )
        for body in bodies
    )
    centre = np.sum([body.volume * _centroid(body) for body in bodies], axis=0) / total
    grasp_object = GraspObject(height_m=float(np.ptp(corners[:, 2])), parts=parts)
    return (
        grasp_object
        if _has_feet(parts, centre) and _stays_upright(grasp_object)
        else replace(grasp_object, is_stable=False)
    )


def _hull(corners: np.ndarray) -> ConvexHull | None:
    try:
        return ConvexHull(corners)
    except QhullError:
        return None  # a sliver


def _centroid(body: ConvexHull) -> np.ndarray:
    """Return the centre of mass (3,) of a homogeneous convex body, summed over tetrahedra from one inner point."""
    inner = body.points[body.vertices].mean(axis=0)
    a, b, c = (body.points[body.simplices[:, k]] for k in range(3))
    volumes = np.abs(np.einsum("ij,ij->i", a - inner, np.cross(b - inner, c - inner)))
    return ((a + b + c + inner) / 4 * volumes[:, None]).sum(axis=0) / volumes.sum()


def _has_feet(parts: tuple[Part, ...], centre: np.ndarray) -> bool:
    """Return whether the centre of mass is above the inside of what touches the table."""
    corners = np.vstack([part.corners() for part in parts])
    feet = corners[corners[:, 2] < corners[:, 2].min() + _FOOT_HEIGHT_M][:, :2]
    try:
        base = ConvexHull(feet)
    except (QhullError, ValueError):
        return False  # a point or an edge
    # Qhull's equations give the distance from each edge, negative inside
    return bool((base.equations[:, :2] @ centre[:2] + base.equations[:, 2] < -_FOOT_HEIGHT_M).all())


def _stays_upright(grasp_object: GraspObject) -> bool:
    """Return whether `grasp_object`, put down a little tilted in either direction, is upright a second later: a
    round bottom has feet by its corners, and rolls over all the same."""
    return all(_settled_tilt_rad(grasp_object, axis) < _UPRIGHT_RAD for axis in np.eye(3)[:2])


def _settled_tilt_rad(grasp_object: GraspObject, axis: np.ndarray) -> float:
    """Return how far `grasp_object` leans [rad] after a second on a table where it began turned about `axis` (3,)."""
    spec = mujoco.MjSpec()
    spec.option.timestep = _TRIAL_STEP_S
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1.0, 1.0, 0.1], contype=BIT_SCENE, conaffinity=BIT_SCENE
    )
    start = np.eye(4)
    start[:3, :3] = Rotation.from_rotvec(_PUT_DOWN_RAD * axis).as_matrix()
    # Put down, not dropped: the lowest corner starts on the table
    start[2, 3] = -float((grasp_object.corners() @ start[2, :3]).min())
    add_object(spec, grasp_object, start)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=round(1.0 / _TRIAL_STEP_S))
    # Vertical component of the object's own z axis, the cosine of its lean
    up = float(data.body(OBJECT_BODY).xmat[8])
    return float(np.arccos(np.clip(up, -1.0, 1.0)))
