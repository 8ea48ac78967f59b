"""The Z1 and its beak gripper as a MuJoCo specification, built from the URDF and STL files of `example-robot-data`."""

from __future__ import annotations

from xml.etree import ElementTree

import mujoco
import numpy as np

from hal.base import z1
from sim_twin.model.convex import JAW_LINKS, load_visual_mesh, split_convex

GROUP_SCENE = 0
"""Table and object: seen by every camera, collides."""
GROUP_VISUAL = 1
"""The arm's full meshes: seen from outside only."""
GROUP_ARM = 3
"""The arm's convex pieces: they collide, and the wrist camera sees them (within 0.6 mm of the mesh at the jaws)."""
GROUP_MOUNT = 4
"""Camera housing and bracket: seen from outside only, as the lens sits behind its own glass."""

# Collision classes: `contype`, `conaffinity`. Upper arm and forearm do not collide with each other: the vendor's joint
# limits keep them apart, and their hulls overlap at the joints.
BIT_SCENE, BIT_BASE, BIT_HAND = 1, 2, 4

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

_HOUSING_MASS_KG = 0.060
_BRACKET_MASS_KG = 0.040
_LINK_RGBA = {"link": (0.80, 0.83, 0.87, 1.0), "dark": (0.16, 0.18, 0.22, 1.0), "jaw": (0.13, 0.14, 0.16, 1.0)}


def _vector(text: str) -> np.ndarray:
    return np.array([float(part) for part in text.split()])


def add_z1(spec: mujoco.MjSpec, T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA) -> None:
    """Add arm, gripper, wrist camera and the seven position servos to `spec`, with link00 at the world's origin.

    The camera with its housing is put at `T_flange_camera` (4, 4).

    Bodies are named as the URDF's links and joints as `hal.base.z1.JOINT_NAMES`. The wrist camera is called `wrist`.

    Raises:
        FileNotFoundError: the wheel with the description is not installed.
    """
    root = ElementTree.parse(z1.urdf_path()).getroot()
    links = {element.get("name", ""): element for element in root.findall("link")}
    joints = [joint for joint in root.findall("joint") if joint.find("parent") is not None]
    bodies = {"world": spec.worldbody}
    index = 0
    for joint in joints:  # the URDF lists parents before children
        origin, parent, child = joint.find("origin"), joint.find("parent"), joint.find("child")
        assert origin is not None and parent is not None and child is not None
        assert not _vector(origin.get("rpy", "0 0 0")).any()
        name = child.get("link", "")
        body = bodies[parent.get("link", "")].add_body(name=name, pos=_vector(origin.get("xyz", "0 0 0")), gravcomp=1.0)
        bodies[name] = body
        _set_inertia(body, links[name])
        _add_geoms(spec, body, name)
        if joint.get("type") == "revolute":
            _add_joint(body, joint, index)
            _add_servo(spec, index)
            index += 1
    spec.add_exclude(name="jaws", bodyname1="gripperStator", bodyname2="gripperMover")
    spec.add_exclude(name="wrist", bodyname1="link06", bodyname2="gripperMover")
    _add_mount(bodies["link06"], T_flange_camera)


def _set_inertia(body: mujoco.MjsBody, link: ElementTree.Element) -> None:
    inertial = link.find("inertial")
    assert inertial is not None
    origin, mass, inertia = inertial.find("origin"), inertial.find("mass"), inertial.find("inertia")
    assert origin is not None and mass is not None and inertia is not None
    body.explicitinertial = True
    body.mass = float(mass.get("value", "nan"))
    body.ipos = _vector(origin.get("xyz", "0 0 0"))
    body.fullinertia = [float(inertia.get(key, "nan")) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")]


def _add_joint(body: mujoco.MjsBody, joint: ElementTree.Element, index: int) -> None:
    axis, dynamics = joint.find("axis"), joint.find("dynamics")
    assert axis is not None and dynamics is not None
    body.add_joint(
        name=z1.JOINT_NAMES[index],
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=_vector(axis.get("xyz", "0 0 1")),
        limited=True,
        range=[z1.Q_MIN[index], z1.Q_MAX[index]],
        damping=[float(dynamics.get("damping", "0")), 0.0, 0.0],
        frictionloss=FRICTIONLOSS[index],
        armature=ARMATURE[index],
        # Gravity compensation is part of the motor's torque, as in the vendor's controller, and shares its limit.
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
    hand = jaw or name in ("link05", "link06")
    for number, corners in enumerate(split_convex(name)):
        piece = spec.add_mesh(name=f"{name}_{number}", smoothnormal=False)
        piece.uservert = corners.ravel()
        body.add_geom(
            name=f"{name}_{number}",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=piece.name,
            group=GROUP_ARM,
            contype=BIT_HAND if hand else BIT_BASE,
            conaffinity=BIT_SCENE | (BIT_BASE if hand else BIT_HAND),
            condim=6 if jaw else 3,
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
        "contype": BIT_HAND,
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
    # MuJoCo cameras look along −z with y up: half a turn about x from the optical frame.
    camera.add_camera(name="wrist", quat=[0.0, 1.0, 0.0, 0.0])
