"""The Z1 and its gripper as a MuJoCo specification, built from its rigid-body model and its STL files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports] - a .pth file leads to it

from hal.base import z1
from hal.base.z1_model import rigid_body_model
from sim_twin.model.parts import JAW_LINKS, load_visual_mesh, split_convex

GROUP_SCENE = 0
"""Table and object: visible to every camera, collides."""
GROUP_VISUAL = 1
"""The arm's full meshes: visible from outside only."""
GROUP_ARM = 3
"""The arm's convex pieces: they collide and are visible to the wrist camera (within 0.6 mm of the mesh at the jaws)."""
GROUP_MOUNT = 4
"""Camera housing and bracket: visible from outside only, as the lens is behind its own glass."""

# Collision classes: `contype`, `conaffinity`. Upper arm and forearm do not collide with each other: the vendor's joint
# limits keep them apart, and their hulls overlap at the joints.
BIT_SCENE, BIT_BASE, BIT_GRIPPER = 1, 2, 4

JAW_FRICTION = (1.0, 0.01, 0.001)
"""Sliding [1], torsional [m], rolling [m]. Rubber pad on plastic or card: 0.8 to 1.2 in tables of friction; torsional:
two thirds of the radius of a contact patch of about 15 mm."""
CONTACT_SOLREF = (0.004, 1.0)
"""Time constant [s] and damping ratio of every contact: four physics steps, critically damped."""
CONTACT_SOLIMP = (0.95, 0.99, 0.0005, 0.5, 2.0)

FRICTIONLOSS = (0.5, 1.0, 0.5, 0.5, 0.5, 0.5, 0.3)
"""(7,) dry friction [Nm]. Half of the URDF's `friction`: with all of it joint 5 (384 Nm/rad) could stick 2.6 mrad off,
more than the real arm's repeatability; the gripper's 1.0 Nm would be a third of a grip."""
ARMATURE = (0.02, 0.04, 0.02, 0.02, 0.02, 0.02, 0.005)
"""(7,) inertia of the rotors behind their gears [kg m²]: not published; of the size of geared drives of 30 Nm."""

_DECIMALS = 9
"""Decimals of the URDF's lengths, masses and inertias, 8 at most: rounding undoes what pinocchio lost in adding the
fixed links up, so that the model is the URDF's to the last bit."""
_HOUSING_MASS_KG = 0.060
_BRACKET_MASS_KG = 0.040
_LINK_RGBA = {"link": (0.80, 0.83, 0.87, 1.0), "dark": (0.16, 0.18, 0.22, 1.0), "jaw": (0.13, 0.14, 0.16, 1.0)}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Link:
    """One URDF link, in its parent's frame at joint angle 0."""

    name: str
    parent: str
    position_m: np.ndarray
    inertia: pin.Inertia
    axis: np.ndarray | None
    """(3,) of the joint that moves it; None where it is fixed."""
    damping: float


def add_z1(spec: mujoco.MjSpec, T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA) -> None:
    """Add arm, gripper, wrist camera and the seven position servos to `spec`, with link00 at the world's origin.

    The camera with its housing is put at `T_flange_camera` (4, 4).

    Bodies are named as the URDF's links and joints as `hal.base.z1.JOINT_NAMES`. The wrist camera is called `wrist`.

    Raises:
        FileNotFoundError: the wheel with the description is not installed.
    """
    bodies = {"world": spec.worldbody}
    index = 0
    for link in _links(rigid_body_model()):
        body = bodies[link.parent].add_body(name=link.name, pos=link.position_m, gravcomp=1.0)
        bodies[link.name] = body
        _set_inertia(body, link.inertia)
        _add_geoms(spec, body, link.name)
        if link.axis is not None:
            _add_joint(body, link, index)
            _add_servo(spec, index)
            index += 1
    spec.add_exclude(name="jaws", bodyname1="gripperStator", bodyname2="gripperMover")
    spec.add_exclude(name="wrist", bodyname1="link06", bodyname2="gripperMover")
    _add_mount(bodies["link06"], T_flange_camera)


def _links(model: pin.Model) -> Iterator[_Link]:
    """Yield the links of `model` from the base outwards."""
    for frame in model.frames:
        if frame.type != pin.FrameType.BODY or frame.name == "world":
            continue
        joint_frame = model.frames[frame.parentFrame]
        parent = model.frames[joint_frame.parentFrame]
        moved = joint_frame.type == pin.FrameType.JOINT
        T_joint_link = model.jointPlacements[frame.parentJoint] if moved else frame.placement
        T_parent_link = parent.placement.inverse() * T_joint_link
        assert np.array_equal(T_parent_link.rotation, np.eye(3)), "the Z1's links are all parallel at angle 0"
        yield _Link(
            name=frame.name,
            parent=parent.name,
            position_m=T_parent_link.translation.round(_DECIMALS),
            inertia=_own_inertia(model, frame.parentJoint) if moved else joint_frame.inertia,
            axis=np.eye(3)["XYZ".index(model.joints[frame.parentJoint].shortname()[-1])] if moved else None,
            damping=float(model.damping[frame.parentJoint - 1]) if moved else 0.0,
        )


def _own_inertia(model: pin.Model, joint: int) -> pin.Inertia:
    """Return the inertia of the link that `joint` moves, without the fixed links that pinocchio added to it."""
    inertia = model.inertias[joint]
    for frame in model.frames:
        if frame.parentJoint == joint and frame.type == pin.FrameType.FIXED_JOINT:
            inertia = inertia - frame.placement.act(frame.inertia)
    return inertia


def _set_inertia(body: mujoco.MjsBody, inertia: pin.Inertia) -> None:
    body.explicitinertial = True
    body.mass = round(inertia.mass, _DECIMALS)
    body.ipos = inertia.lever.round(_DECIMALS)
    # MuJoCo's order is the diagonal first
    (ixx, ixy, ixz), (_, iyy, iyz), (_, _, izz) = inertia.inertia
    body.fullinertia = [round(float(value), _DECIMALS) for value in (ixx, iyy, izz, ixy, ixz, iyz)]


def _add_joint(body: mujoco.MjsBody, link: _Link, index: int) -> None:
    body.add_joint(
        name=z1.JOINT_NAMES[index],
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=link.axis,
        limited=True,
        range=[z1.Q_MIN[index], z1.Q_MAX[index]],
        damping=[link.damping, 0.0, 0.0],
        frictionloss=FRICTIONLOSS[index],
        armature=ARMATURE[index],
        # Gravity compensation is part of the motor's torque, as in the vendor's controller, and within its limit.
        actgravcomp=True,
        actfrclimited=True,
        actfrcrange=[-z1.TAU_MAX[index], z1.TAU_MAX[index]],
    )


def _add_servo(spec: mujoco.MjSpec, index: int) -> None:
    """Torque = ctrl − K_P q − K_D dq, with ctrl = K_P q_cmd + K_D dq_cmd written by the world.

    MuJoCo's own position servo damps towards rest; the Z1's towards the commanded speed.
    """
    spec.add_actuator(
        name=z1.JOINT_NAMES[index],
        target=z1.JOINT_NAMES[index],
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        gainprm=[1.0] + [0.0] * 9,
        biasprm=[0.0, -z1.KP[index], -z1.KD[index]] + [0.0] * 7,
    )


def _add_geoms(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str) -> None:
    vertices, faces = load_visual_mesh(name)
    jaw = name in JAW_LINKS
    colour = "jaw" if jaw else "dark" if name in ("link00", "link04", "link06") else "link"
    # MuJoCo's volume inertia needs a watertight mesh; this one is for rendering, and the body's own inertia counts
    visual = spec.add_mesh(name=f"{name}_visual", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    visual.uservert, visual.userface = vertices.ravel(), faces.ravel()
    body.add_geom(
        name=f"{name}_visual",
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=visual.name,
        group=GROUP_VISUAL,
        contype=0,
        conaffinity=0,
        material=colour,
    )
    is_gripper = jaw or name in ("link05", "link06")
    for number, corners in enumerate(split_convex(name)):
        piece = spec.add_mesh(name=f"{name}_{number}", smoothnormal=False)
        piece.uservert = corners.ravel()
        body.add_geom(
            name=f"{name}_{number}",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=piece.name,
            group=GROUP_ARM,
            contype=BIT_GRIPPER if is_gripper else BIT_BASE,
            conaffinity=BIT_SCENE | (BIT_BASE if is_gripper else BIT_GRIPPER),
            # Torsional and rolling friction (MuJoCo's condim 6) where something is held
            condim=6 if jaw else 3,
            # MuJoCo takes the friction of the geom with the higher priority, here the rubber's
            priority=1 if jaw else 0,
            friction=JAW_FRICTION if jaw else (0.3, 0.005, 0.0001),
            solref=CONTACT_SOLREF,
            solimp=CONTACT_SOLIMP,
            rgba=_LINK_RGBA[colour],
        )


def _add_mount(flange: mujoco.MjsBody, pose: np.ndarray) -> None:
    """Add the D405's housing, its bracket (on the flange's +y side) and the camera."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, pose[:3, :3].ravel().copy())
    camera = flange.add_body(name="camera", pos=pose[:3, 3], quat=quat, gravcomp=1.0)
    common = {
        "group": GROUP_MOUNT,
        "contype": BIT_GRIPPER,
        "conaffinity": BIT_SCENE | BIT_BASE,
        "type": mujoco.mjtGeom.mjGEOM_BOX,
    }
    camera.add_geom(
        name="camera_housing",
        size=(z1.CAMERA_HOUSING_HIGH - z1.CAMERA_HOUSING_LOW) / 2,
        pos=(z1.CAMERA_HOUSING_HIGH + z1.CAMERA_HOUSING_LOW) / 2,
        mass=_HOUSING_MASS_KG,
        material="camera",
        **common,
    )
    # A printed plate of 8 mm, 36 g; with its screws 40
    middle, along = (z1.BRACKET_FOOT + z1.BRACKET_HEAD) / 2, z1.BRACKET_HEAD - z1.BRACKET_FOOT
    angle = np.arctan2(-along[0], along[1])
    bracket = flange.add_body(
        name="camera_bracket", pos=middle, quat=[np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)], gravcomp=1.0
    )
    bracket.add_geom(
        name="camera_bracket",
        size=[0.004, np.linalg.norm(along) / 2, z1.BRACKET_HALF_WIDTH_M],
        mass=_BRACKET_MASS_KG,
        material="bracket",
        **common,
    )
    # MuJoCo's cameras point along −z with y up: half a turn about x from the optical frame.
    camera.add_camera(name="wrist", quat=[0.0, 1.0, 0.0, 0.0])
