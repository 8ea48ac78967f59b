"""The twin's scene in Rerun, live or in a file: the robot, the table, and the objects on it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import rerun as rr

from hal.base.z1 import N_JOINTS
from sim_twin.model.world import SceneView
from sim_twin.model.z1_mjcf import GROUP_SCENE
from z1_runtime.visualization import blueprint
from z1_runtime.visualization.recorder import Recorder

RATE_HZ = 20.0
"""Rate at which a live view is updated, lower under load [Hz]."""

Drawing = Iterator[tuple[str, Any]]


class TwinView:
    """Recording of a twin that runs elsewhere; each `update` logs its present poses.

    Args:
        twin: the scene to show.
        out: the .rrd file to write; None writes none.
        port: TCP port of the live view on the loopback; None serves none.

    Raises:
        z1_runtime.visualization.recorder.ViewerPortError: another program listens on `port`.
    """

    def __init__(self, twin: SceneView, out: Path | None = None, port: int | None = None) -> None:
        self._twin = twin
        self._recorder = _SceneRecorder(out, port, twin.model)
        self._recorder.write_static()
        self._snapshot = mujoco.MjData(twin.model)

    def update(self) -> None:
        """Log the present poses."""
        data = self._twin.snapshot(self._snapshot)
        self._recorder.write(data.time, lambda: self._recorder.draw_twin(data))

    def close(self, timeout_s: float = 5.0) -> None:
        """Flush to the viewer or the file, for at most `timeout_s` [s], and close."""
        self._recorder.close(timeout_s)


class _SceneRecorder(Recorder):
    """A recording of a scene: its geoms once, then poses."""

    def __init__(self, out: Path | None, port: int | None, model: mujoco.MjModel) -> None:
        super().__init__(out, port)
        self._model = model

    def write_static(self) -> None:
        super().write_static()
        for path, entity in draw_geoms(self._model):
            self._stream.log(path, entity, static=True)

    def draw_twin(self, data: mujoco.MjData) -> Drawing:
        """Yield the poses of the arm and of the objects."""
        q = data.qpos[:N_JOINTS].copy()
        yield from self.robot.draw_pose(q)
        yield blueprint.POSITION, rr.Scalars(q)
        for body in _free_bodies(self._model):
            rotation = data.xmat[body].reshape(3, 3)
            yield _body_path(self._model, body), rr.Transform3D(translation=data.xpos[body], mat3x3=rotation)


def draw_geoms(model: mujoco.MjModel) -> Drawing:
    """Yield every geom of the scene except the arm's, in its body's frame."""
    for geom in np.flatnonzero(model.geom_group == GROUP_SCENE):
        path = f"{_body_path(model, int(model.geom_bodyid[geom]))}/geom{geom}"
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        yield path, rr.Transform3D(translation=model.geom_pos[geom], mat3x3=rotation.reshape(3, 3))
        yield path, _shape(model, int(geom))


def _shape(model: mujoco.MjModel, geom: int) -> Any:
    size, kind = model.geom_size[geom], mujoco.mjtGeom(model.geom_type[geom])
    material = int(model.geom_matid[geom])  # -1: the geom has its own colour
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    colour = [(255 * rgba).astype(np.uint8)]
    solid = rr.components.FillMode.Solid
    match kind:
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            # MuJoCo's lengths are halves.
            return rr.Cylinders3D(lengths=[2 * size[1]], radii=[size[0]], colors=colour, fill_mode=solid)
        case mujoco.mjtGeom.mjGEOM_MESH:
            return _mesh(model, int(model.geom_dataid[geom]), rgba)
        case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            return rr.Ellipsoids3D(half_sizes=[size], colors=colour, fill_mode=solid)
        case _:
            return rr.Boxes3D(half_sizes=[size], colors=colour, fill_mode=solid)


def _mesh(model: mujoco.MjModel, mesh: int, rgba: np.ndarray) -> rr.Mesh3D:
    vertex, face = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
    return rr.Mesh3D(
        vertex_positions=model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]],
        triangle_indices=model.mesh_face[face : face + model.mesh_facenum[mesh]],
        albedo_factor=rgba,
    )


def _free_bodies(model: mujoco.MjModel) -> list[int]:
    """Return the bodies on the table that are free to move."""
    return [int(model.jnt_bodyid[j]) for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)]


def _body_path(model: mujoco.MjModel, body: int) -> str:
    return f"{blueprint.WORLD}/twin/{model.body(body).name}"
