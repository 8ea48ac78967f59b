"""A user's mesh as a thing to grasp: read, checked for its size, cut into convex parts by CoACD, kept on disk."""

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
from sim_twin.model.objects import OBJECT_BODY, add_object
from sim_twin.model.parts import GraspObject, Part
from sim_twin.model.z1_mjcf import BIT_SCENE

if TYPE_CHECKING:  # trimesh takes two seconds to import
    import trimesh

SUFFIXES = (".stl", ".obj", ".ply", ".off", ".glb")
SIZE_M = (0.02, 0.35)
"""Least and most that the longest edge of a mesh's bounding box may measure [m]: what fits the hand and the table."""
MASS_KG = (0.001, 2.0)
"""Least and most mass [kg]; the Z1 carries 2 kg at most."""
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "metres": 1.0}
# Concavities deeper than 5 % of the size are kept, in 32 parts at most, each of 64 corners: physics stays quick.
_COACD = {"threshold": 0.05, "max_convex_hull": 32, "decimate": True, "max_ch_vertex": 64, "seed": 0}
# What cannot be closed is cut as it is, which fills it: CoACD's own thickening keeps a vessel hollow, but makes so many
# triangles of it that the cutting takes many minutes.
_COACD_OPEN = {"preprocess_mode": "off", "resolution": 1000, "mcts_iterations": 60}
_RGBA = (0.36, 0.52, 0.62, 1.0)
_PUT_DOWN_RAD, _UPRIGHT_RAD, _TRIAL_STEP_S = float(np.deg2rad(2.0)), float(np.deg2rad(6.0)), 1e-3
_STANDS_ON_M = 1.5e-3
"""Corners this little above the lowest one count as feet: meshes are seldom quite level."""


class MeshError(Z1Error, ValueError):
    """A mesh that cannot be grasped; the message says what was seen and what to do."""

    default_code = "mesh"


def load_mesh_object(path: Path, scale: float, mass_kg: float) -> tuple[str, GraspObject]:
    """Return a mesh file as an object, and a name for it that no other mesh, scale or mass has.

    Args:
        path: STL, OBJ, PLY, OFF or GLB, z up; watertight or not, but walls without thickness come out filled.
        scale: metres in one of the file's units.
        mass_kg: of the whole, spread evenly over the parts' volumes.

    Raises:
        MeshError: it is missing or no mesh, or its size or mass is absurd.
    """
    if not (MASS_KG[0] <= mass_kg <= MASS_KG[1]):
        raise MeshError(f"--mass is {mass_kg:g} kg; allowed is {MASS_KG[0]:g} to {MASS_KG[1]:g} kg.")
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
        raise MeshError(f"{path} is no mesh by its name; allowed: {', '.join(SUFFIXES)}.")
    try:
        return path.read_bytes()
    except OSError as error:
        raise MeshError(f"the mesh {path} cannot be read: {error.strerror}.") from error


def _parse(path: Path, content: bytes) -> trimesh.Trimesh:
    import trimesh

    try:
        # Of an OBJ only the shape counts: its materials would be looked for in other files
        mesh = trimesh.load(
            trimesh.util.wrap_as_stream(content),
            file_type=path.suffix[1:].lower(),
            force="mesh",
            skip_materials=True,
        )
    except Exception as error:  # readers of six formats fail in as many ways
        raise MeshError(f"{path} cannot be read as {path.suffix[1:].upper()}: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise MeshError(f"{path} holds no triangles; a mesh with faces is needed, not a cloud of points or lines.")
    if not np.isfinite(mesh.vertices).all():
        raise MeshError(f"{path} holds vertices that are not finite; export it anew.")
    return mesh


def _check_size(path: Path, extents: np.ndarray, scale: float) -> None:
    """Refuse a mesh whose size at `scale` cannot be grasped, with the scales that would make sense."""
    low, high = SIZE_M
    if not (np.isfinite(scale) and scale > 0):
        raise MeshError(f"--scale is {scale:g}; it must be above 0: metres in one of the file's units.")
    longest = float(extents.max())
    if low <= scale * longest <= high:
        return
    size = " × ".join(f"{value:.4g}" for value in scale * extents)
    fitting = [f"--scale {unit:g} if it is in {name}" for name, unit in _UNITS.items() if low <= unit * longest <= high]
    advice = f"Give {', or '.join(fitting)}." if fitting else "No usual unit makes it fit; give the --scale that does."
    raise MeshError(
        f"{path} measures {size} m with --scale {scale:g}; its longest edge must be {low:g} to {high:g} m. {advice}"
    )


def _decompose(mesh: trimesh.Trimesh, content: bytes) -> list[np.ndarray]:
    """Return the corners (M, 3) of convex parts that together are the mesh, in the file's units; cached by content."""
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
    partial = path.with_suffix(f".{os.getpid()}.partial")
    with partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **{f"hull_{k:02}": hull for k, hull in enumerate(hulls)})
    partial.replace(path)
    return hulls


def _assemble(path: Path, hulls: list[np.ndarray], mass_kg: float) -> GraspObject:
    """Return the object whose origin is the middle of its bounding box."""
    corners = np.vstack(hulls)
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    bodies = [_hull(hull - middle) for hull in hulls]
    bodies = [body for body in bodies if body is not None]
    if not bodies:
        raise MeshError(f"{path} is flat: no part of it has a volume; give it a thickness.")
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
    thing = GraspObject(height_m=float(np.ptp(corners[:, 2])), parts=parts)
    return thing if _has_feet(parts, centre) and _stays_upright(thing) else replace(thing, stands=False)


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
    feet = corners[corners[:, 2] < corners[:, 2].min() + _STANDS_ON_M][:, :2]
    try:
        base = ConvexHull(feet)
    except (QhullError, ValueError):
        return False  # a point or an edge
    return bool((base.equations[:, :2] @ centre[:2] + base.equations[:, 2] < -_STANDS_ON_M).all())


def _stays_upright(thing: GraspObject) -> bool:
    """Return whether `thing`, put down a little aslant in either direction, still stands a second later: a round bottom
    has feet by its corners, and rolls over all the same."""
    return all(_settled_tilt_rad(thing, axis) < _UPRIGHT_RAD for axis in np.eye(3)[:2])


def _settled_tilt_rad(thing: GraspObject, axis: np.ndarray) -> float:
    """Return how far `thing` leans [rad] after a second on a table where it began turned about `axis` (3,)."""
    spec = mujoco.MjSpec()
    spec.option.timestep = _TRIAL_STEP_S
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1.0, 1.0, 0.1], contype=BIT_SCENE, conaffinity=BIT_SCENE
    )
    start = np.eye(4)
    start[:3, :3] = Rotation.from_rotvec(_PUT_DOWN_RAD * axis).as_matrix()
    start[2, 3] = -float((thing.corners() @ start[2, :3]).min())
    add_object(spec, thing, start)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=round(1.0 / _TRIAL_STEP_S))
    up = float(data.body(OBJECT_BODY).xmat[8])
    return float(np.arccos(np.clip(up, -1.0, 1.0)))
