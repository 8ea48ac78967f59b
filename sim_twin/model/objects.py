"""Graspable objects: shape, mass and friction, each with its reason."""

from __future__ import annotations

import mujoco
import numpy as np

from sim_twin.model.more_objects import EXTENDED
from sim_twin.model.parts import GraspObject, Part, make_lathe
from sim_twin.model.z1_mjcf import BIT_BASE, BIT_GRIPPER, BIT_SCENE, CONTACT_SOLIMP, CONTACT_SOLREF, GROUP_SCENE

OBJECT_BODY = "object"

# Plastic or card on a melamine table: 0.3 to 0.5 in tables of friction. The jaws' rubber outranks it by priority.
_FRICTION = (0.4, 0.005, 0.0001)


_BOTTLE_PROFILE = (
    (0.000, 0.030),
    (0.004, 0.033),
    (0.060, 0.033),
    (0.120, 0.033),
    (0.150, 0.033),
    (0.178, 0.013),
    (0.200, 0.013),
)
_PET, _LABEL, _CAP = (0.42, 0.66, 0.80, 1.0), (0.90, 0.92, 0.95, 1.0), (0.10, 0.28, 0.62, 1.0)

_PAPER: dict[str, GraspObject] = {
    # A half-litre bottle, half full: 25 g of PET and 275 g of water, 80 mm high (its part inside the label's
    # segment is spread over that segment). The water is modelled as frozen: at grasping accelerations its free surface
    # moves the centre of mass by a few millimetres.
    "bottle": GraspObject(
        height_m=0.200,
        parts=make_lathe(
            _BOTTLE_PROFILE,
            ((0.014, _PET), (0.199, _PET), (0.076, _LABEL), (0.005, _PET), (0.003, _PET), (0.003, _CAP)),
        ),
    ),
    # A pack of biscuits: card, 0.6 kg/l. Three different edges, so that no two faces can be mixed up. The 40 mm edge
    # is across the view, along base y.
    "box": GraspObject(
        height_m=0.150,
        parts=(Part(kind="box", size_m=(0.035, 0.020, 0.075), mass_kg=0.25, rgba=(0.85, 0.50, 0.18, 1.0)),),
    ),
    # A filled tin of spice or crisps: 0.47 kg/l.
    "cylinder": GraspObject(
        height_m=0.150,
        parts=(Part(kind="cylinder", size_m=(0.030, 0.075), mass_kg=0.20, rgba=(0.75, 0.16, 0.16, 1.0)),),
    ),
}
PAPER_OBJECTS, EXTENDED_OBJECTS = tuple(_PAPER), tuple(EXTENDED)
"""The paper's three, and the further shapes."""
OBJECTS = _PAPER | EXTENDED
OBJECT_NAMES = tuple(OBJECTS)


def add_object(
    spec: mujoco.MjSpec,
    grasp_object: GraspObject,
    T_base_object: np.ndarray,
    *,
    name: str = OBJECT_BODY,
    mass_factor: float = 1.0,
) -> None:
    """Add `grasp_object` as a free body called `name` at `T_base_object` (4, 4), `mass_factor` times its mass."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, T_base_object[:3, :3].ravel().copy())
    body = spec.worldbody.add_body(name=name, pos=T_base_object[:3, 3], quat=quat)
    body.add_freejoint(name=name)
    for number, part in enumerate(grasp_object.parts):
        geom = body.add_geom(
            name=f"{name}_{number}",
            group=GROUP_SCENE,
            mass=mass_factor * part.mass_kg,
            rgba=part.rgba,
            contype=BIT_SCENE,
            conaffinity=BIT_SCENE | BIT_BASE | BIT_GRIPPER,
            # MuJoCo's condim 4 adds torsional friction: without it nothing resists a turn about a contact's normal
            condim=4,
            friction=_FRICTION,
            solref=CONTACT_SOLREF,
            solimp=CONTACT_SOLIMP,
        )
        part.shape(spec, geom)
