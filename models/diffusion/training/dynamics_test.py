"""Dynamics test of grasps in MuJoCo: the gripper closes with force and is accelerated; the object stays or is lost.

The exact check of `labels.py` is geometry: no mass, no slip, no turning. Fingers, mass, force and friction here are
those of the gripper and of a light household object. The test runs in the gripper's own frame: an accelerated gripper
is equivalent to one at rest under gravity in another direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from models.diffusion.training.convex import split_turned_solid
from models.diffusion.training.grippers import ParallelGripperSpec
from models.diffusion.training.labels import GraspCheck
from models.diffusion.training.solids import BOX, CAPSULE, TORUS, Solid

if TYPE_CHECKING:
    import mujoco

_TIMESTEP_S = 0.002  # MuJoCo's default
_RING_PIECES = 16
_FINGER_MASS_KG = 0.1
_FINGER_BIT, _OBJECT_BIT = 1, 2
_FINGERS = (1, 2)  # geom indices; the palm, part of the world, has 0, the object the rest
_START_GAP_M = 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class DynamicsTestConfig:
    """Forces, times and masses of the dynamics test."""

    force_n: float = 40.0
    """Of each finger [N]; a Robotiq 2F-140 gives 10 to 125 N (its datasheet)."""
    closing_speed_m_s: float = 0.13
    """Of each finger until it touches [m/s]; a 2F-140 closes with 0.015 to 0.125 m/s each (its datasheet)."""
    settle_s: float = 0.3
    """Closing and coming to rest, without gravity [s]."""
    hold_s: float = 0.16
    """Duration of each acceleration [s]."""
    acceleration_m_s2: float = 20.0
    """Acceleration in each direction, twice gravity [m/s²]."""
    density_kg_m3: float = 500.0
    """Of the object [kg/m³]; packed food and half-full bottles have 400 to 700."""
    mass_kg: tuple[float, float] = (0.05, 0.5)
    """Minimum and maximum mass of an object [kg]."""


def simulate_grasps(
    solid: Solid,
    T: np.ndarray,
    check: GraspCheck,
    gripper: ParallelGripperSpec,
    config: DynamicsTestConfig | None = None,
) -> np.ndarray:
    """Return the mask (N,) of the grasps `T` (N, 4, 4) in the solid's frame that hold it in simulation.

    The pads close on the object, then it is accelerated both ways along all three axes of the gripper. It is held if
    both fingers still touch it after each. A grasp whose pads close on nothing, or whose open gripper is not free, is
    not simulated: it does not hold.

    Args:
        solid: the object.
        T: poses in the grasp frame (z approach, y closing).
        check: result of `check_grasps` for the same grasps; it gives the fingers' start.
        gripper: two fingers that close symmetrically, as those of a 2F-140 do.
        config: forces, times and masses.
    """
    import mujoco

    config = config or DynamicsTestConfig()
    held = np.zeros(len(T), dtype=bool)
    simulated = np.flatnonzero(np.isfinite(check.widths_m))
    if not len(simulated):
        return held
    model = _build_model(solid, gripper, config)
    data = mujoco.MjData(model)
    for index in simulated:
        mujoco.mj_resetData(model, data)
        # Both fingers start just outside the contact that is further from the middle.
        opening = 0.5 * check.widths_m[index] + abs(check.offsets_m[index]) + _START_GAP_M
        data.qpos[:2] = opening
        data.ctrl[:2] = config.force_n
        T_grasp_object = np.linalg.inv(T[index])
        data.qpos[2:5] = T_grasp_object[:3, 3]
        mujoco.mju_mat2Quat(data.qpos[5:9], T_grasp_object[:3, :3].ravel())
        held[index] = _is_held(model, data, config)
    return held


def _is_held(model: mujoco.MjModel, data: mujoco.MjData, config: DynamicsTestConfig) -> bool:
    import mujoco

    model.opt.gravity[:] = 0.0
    mujoco.mj_step(model, data, round(config.settle_s / _TIMESTEP_S))
    steps = round(config.hold_s / _TIMESTEP_S)
    for axis in (2, 0, 1):
        for sign in (-1.0, 1.0):
            if not _both_touch(model, data):
                return False
            model.opt.gravity[:] = 0.0
            model.opt.gravity[axis] = sign * config.acceleration_m_s2
            mujoco.mj_step(model, data, steps)
    return _both_touch(model, data)


def _both_touch(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
    """Return whether each finger touches the object."""
    touched = {geom for pair in data.contact.geom[: data.ncon].tolist() if max(pair) > max(_FINGERS) for geom in pair}
    return touched.issuperset(_FINGERS)


def _build_model(solid: Solid, gripper: ParallelGripperSpec, config: DynamicsTestConfig) -> mujoco.MjModel:
    """Return the gripper in its own frame and the object as a free body; qpos: two openings [m], then its pose."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.option.timestep = _TIMESTEP_S
    # Stiff friction rows, as in the twin: held objects would creep otherwise
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    _add_gripper(spec, gripper, config)
    body = spec.worldbody.add_body(name="object")
    body.add_freejoint()
    added = set()
    for row, outline in zip(solid.parts, solid.profiles, strict=True):
        if row.tobytes() + outline.tobytes() not in added:  # shards repeat parts, which would count the mass twice
            _add_part(spec, body, row, outline)
            added.add(row.tobytes() + outline.tobytes())
    for geom in body.geoms:
        geom.density = config.density_kg_m3
        geom.contype, geom.conaffinity = _OBJECT_BIT, _FINGER_BIT
        # Torsional and rolling friction are MuJoCo's defaults
        geom.condim, geom.friction = 4, [gripper.friction, 0.005, 0.0001]
        # The shortest time constant that MuJoCo integrates stably, two time steps
        geom.solref = [2.0 * _TIMESTEP_S, 1.0]
    model = spec.compile()
    weight = float(np.clip(model.body_mass[-1], *config.mass_kg) / model.body_mass[-1])
    model.body_mass[-1] *= weight
    model.body_inertia[-1] *= weight
    # The constants that MuJoCo derives from masses follow the scaled ones
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _add_gripper(spec: mujoco.MjSpec, gripper: ParallelGripperSpec, config: DynamicsTestConfig) -> None:
    """Add two fingers that slide along ±y, coupled to close symmetrically, and the palm behind them."""
    import mujoco

    size = [gripper.finger_width_m / 2.0, gripper.finger_thickness_m / 2.0, gripper.finger_length_m / 2.0]
    touch = {
        "type": mujoco.mjtGeom.mjGEOM_BOX,
        "contype": _FINGER_BIT,
        "conaffinity": _OBJECT_BIT,
        "condim": 4,
        "friction": [gripper.friction, 0.005, 0.0001],
        "solref": [2.0 * _TIMESTEP_S, 1.0],
    }
    for name, side in (("left", 1.0), ("right", -1.0)):
        finger = spec.worldbody.add_body(name=name)
        finger.add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=[0.0, side, 0.0],
            # At this speed the damping balances the force
            damping=[config.force_n / config.closing_speed_m_s, 0.0, 0.0],
        )
        finger.add_geom(size=size, pos=[0.0, side * size[1], -size[2]], mass=_FINGER_MASS_KG, **touch)
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gear = [-1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    coupling = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1="left", name2="right")
    coupling.data[:2] = [0.0, 1.0]
    half = gripper.palm_length_m / 2.0
    spec.worldbody.add_geom(
        size=[gripper.palm_width_m / 2.0, gripper.max_width_m / 2.0, half],
        pos=[0.0, 0.0, -gripper.finger_length_m - half],
        **touch,
    )


def _add_part(spec: mujoco.MjSpec, body: mujoco.MjsBody, row: np.ndarray, outline: np.ndarray) -> None:
    """Add one part of a solid; edges are sharp where the solid's are rounded."""
    import mujoco

    R, origin = row[6:15].reshape(3, 3), row[15:18]
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, R.ravel())
    kind, sizes = int(row[0]), row[2:5]
    if kind == BOX:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=sizes, pos=origin, quat=quat)
    elif kind == CAPSULE:
        shape = mujoco.mjtGeom.mjGEOM_CAPSULE if sizes[1] > 0.0 else mujoco.mjtGeom.mjGEOM_SPHERE
        body.add_geom(type=shape, size=[sizes[0], sizes[1], 0.0], pos=origin, quat=quat)
    elif kind == TORUS:
        angle = 2.0 * np.pi * np.arange(_RING_PIECES + 1) / _RING_PIECES
        ring = np.column_stack([sizes[0] * np.cos(angle), np.zeros(len(angle)), sizes[0] * np.sin(angle)])
        ring = ring @ R.T + origin
        for start, end in pairwise(ring):
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*start, *end], size=[sizes[1], 0.0, 0.0])
    else:
        for piece in split_turned_solid(outline[: int(row[5])], row[1]):
            mesh = spec.add_mesh(name=f"piece {len(spec.meshes)}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
            mesh.uservert = piece.ravel()
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, pos=origin, quat=quat)
