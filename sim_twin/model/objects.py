"""Graspable objects: shape, mass and friction, each with its reason; the paper's, and an extended set."""

from __future__ import annotations

import mujoco
import numpy as np

from sim_twin.model.parts import GraspObject, Part, Rgba, make_homogeneous_lathe, make_lathe, make_wall
from sim_twin.model.z1_mjcf import BIT_BASE, BIT_GRIPPER, BIT_SCENE, CONTACT_SOLIMP, CONTACT_SOLREF, GROUP_SCENE

_CLAY, _STEEL, _GREEN, _GLASS = (
    (0.80, 0.76, 0.68, 1.0),
    (0.62, 0.66, 0.70, 1.0),
    (0.35, 0.58, 0.30, 1.0),
    (0.72, 0.82, 0.80, 1.0),
)
_WOOD, _BLUE, _RED, _WHITE = (
    (0.72, 0.52, 0.30, 1.0),
    (0.20, 0.38, 0.66, 1.0),
    (0.76, 0.20, 0.18, 1.0),
    (0.92, 0.92, 0.90, 1.0),
)
_YELLOW, _DARK = (0.88, 0.72, 0.20, 1.0), (0.18, 0.19, 0.22, 1.0)


def _box(edges_m: tuple[float, float, float], at_m: tuple[float, float, float], mass_kg: float, rgba: Rgba) -> Part:
    """Return a box of `edges_m` around `at_m` in the object's frame."""
    x, y, z = (edge / 2 for edge in edges_m)
    return Part(kind="box", size_m=(x, y, z), xy_m=at_m[:2], z_m=at_m[2], mass_kg=mass_kg, rgba=rgba)


def _disc(radius_m: float, z_m: tuple[float, float], mass_kg: float, rgba: Rgba) -> Part:
    low, high = z_m
    size = (radius_m, (high - low) / 2)
    return Part(kind="cylinder", size_m=size, z_m=(low + high) / 2, mass_kg=mass_kg, rgba=rgba)


def _vessel(
    foot_m: float, rim_m: float, height_m: float, *, thick_m: float, masses_kg: tuple[float, float], rgba: Rgba
) -> tuple[Part, ...]:
    """Return a round vessel, open above: outer radii at foot and rim, and the masses of bottom and wall."""
    half = height_m / 2
    return (
        _disc(foot_m, (-half, -half + thick_m), masses_kg[0], rgba),
        *make_wall((foot_m - thick_m, foot_m), (rim_m - thick_m, rim_m), (-half + thick_m, half), masses_kg[1], rgba),
    )


def _handle(
    radius_m: float, *, out_m: float, high_m: float, thick_m: float, mass_kg: float, rgba: Rgba
) -> tuple[Part, ...]:
    """Return a square-cornered handle along +y of a wall of `radius_m`: two arms and the grip."""
    middle, arm = radius_m + out_m / 2, (thick_m, out_m, thick_m)
    arms = [(0.0, middle, side * (high_m - thick_m) / 2) for side in (-1.0, 1.0)]
    grip = _box((thick_m, thick_m, high_m), (0.0, radius_m + out_m, 0.0), mass_kg / 2, rgba)
    return (*(_box(arm, at, mass_kg / 4, rgba) for at in arms), grip)


def _prism(outline_m: np.ndarray, length_m: float, axis: int, mass_kg: float, rgba: Rgba) -> Part:
    """Return the convex `outline_m` (N, 2), in the other two axes in their order, drawn out along `axis`."""
    ends = [np.insert(outline_m, axis, side * length_m / 2, axis=1) for side in (-1.0, 1.0)]
    corners = tuple(float(value) for value in np.vstack(ends).ravel())
    return Part(kind="hull", size_m=corners, mass_kg=mass_kg, rgba=rgba)


_BALL_RADIUS_M, _BALL_FLAT_M = 0.031, 0.012


def _ball_profile() -> tuple[tuple[float, float], ...]:
    """Return the profile of a sphere with a flat foot."""
    foot = np.sqrt(_BALL_RADIUS_M**2 - _BALL_FLAT_M**2)
    heights = np.linspace(-foot, 0.998 * _BALL_RADIUS_M, 13)
    return tuple((float(z + foot), float(np.sqrt(_BALL_RADIUS_M**2 - z * z))) for z in heights)


_HEXAGON = 0.030 * np.array([[np.cos(a), np.sin(a)] for a in np.arange(6) * np.pi / 3])

EXTENDED: dict[str, GraspObject] = {
    # A juggling ball: leather around millet; its weight flattens the foot, so that it does not roll.
    "ball": GraspObject(height_m=_ball_profile()[-1][0], parts=make_homogeneous_lathe(_ball_profile(), 0.13, _RED)),
    # A cereal bowl of melamine: 110 mm at the rim, too wide for the jaws; 4 mm of wall can be taken.
    "bowl": GraspObject(
        height_m=0.055, parts=_vessel(0.030, 0.055, 0.055, thick_m=0.004, masses_kg=(0.05, 0.13), rgba=_GREEN)
    ),
    # A slim quarter-litre can, full.
    "can": GraspObject(
        height_m=0.135,
        parts=make_homogeneous_lathe(((0.0, 0.0235), (0.006, 0.0265), (0.124, 0.0265), (0.135, 0.0235)), 0.27, _STEEL),
    ),
    # A turned skittle's upper end: nothing on it is upright.
    "cone": GraspObject(height_m=0.100, parts=make_homogeneous_lathe(((0.0, 0.032), (0.100, 0.010)), 0.12, _YELLOW)),
    # A tumbler of thick plastic, empty: light, so that a touch moves it.
    "cup": GraspObject(
        height_m=0.090, parts=_vessel(0.024, 0.031, 0.090, thick_m=0.003, masses_kg=(0.015, 0.055), rgba=_BLUE)
    ),
    # Turned wood; the 16 mm stem is the best hold, the head the widest.
    "goblet": GraspObject(
        height_m=0.130,
        parts=make_homogeneous_lathe(
            ((0.0, 0.032), (0.010, 0.030), (0.016, 0.008), (0.070, 0.008), (0.090, 0.026), (0.130, 0.030)),
            0.15,
            _WOOD,
        ),
    ),
    # Jam: 210 ml, full, with a lid a little narrower than the glass.
    "jar": GraspObject(
        height_m=0.085,
        parts=(
            _disc(0.031, (-0.0425, 0.0255), 0.28, _GLASS),
            _disc(0.029, (0.0255, 0.0425), 0.02, _RED),
        ),
    ),
    # Two beech bars of 30 × 30 mm, 0.7 kg/l.
    "l_block": GraspObject(
        height_m=0.110,
        parts=(
            _box((0.030, 0.090, 0.030), (0.0, 0.0, -0.040), 0.057, _WOOD),
            _box((0.030, 0.030, 0.080), (0.0, -0.030, 0.015), 0.050, _WOOD),
        ),
    ),
    # A small stoneware mug; the handle is across the view.
    "mug": GraspObject(
        height_m=0.080,
        parts=(
            *_vessel(0.031, 0.032, 0.080, thick_m=0.004, masses_kg=(0.04, 0.14), rgba=_CLAY),
            *_handle(0.0305, out_m=0.024, high_m=0.050, thick_m=0.008, mass_kg=0.03, rgba=_CLAY),
        ),
    ),
    # A ripe pear: 0.95 kg/l.
    "pear": GraspObject(
        height_m=0.095,
        parts=make_homogeneous_lathe(
            (
                (0.0, 0.014),
                (0.008, 0.025),
                (0.022, 0.031),
                (0.036, 0.031),
                (0.052, 0.024),
                (0.070, 0.017),
                (0.086, 0.015),
                (0.095, 0.007),
            ),
            0.16,
            _GREEN,
        ),
    ),
    # A slate on its edge: a side of 16 × 120 mm is all that the jaws can close on.
    "plate": GraspObject(height_m=0.120, parts=(_box((0.100, 0.016, 0.120), (0.0, 0.0, 0.0), 0.22, _DARK),)),
    # A tin with six sides, 60 mm from edge to edge, 52 mm from side to side.
    "prism": GraspObject(height_m=0.110, parts=(_prism(_HEXAGON, 0.110, 2, 0.14, _BLUE),)),
    # A cleaner's bottle, a third full: the head with its trigger overhangs towards the robot.
    "spray_bottle": GraspObject(
        height_m=0.190,
        parts=(
            _disc(0.030, (-0.095, 0.025), 0.18, _WHITE),
            Part(kind="frustum", size_m=(0.030, 0.012, 0.015), z_m=0.040, mass_kg=0.015, rgba=_WHITE),
            _disc(0.012, (0.055, 0.065), 0.005, _WHITE),
            _box((0.070, 0.024, 0.030), (-0.012, 0.0, 0.080), 0.025, _RED),
            _box((0.008, 0.014, 0.035), (-0.034, 0.0, 0.0475), 0.003, _RED),
        ),
    ),
    # Parcel tape on its core, flat on the table: 90 mm across, the ring 17 mm thick.
    "tape_roll": GraspObject(
        height_m=0.048, parts=make_wall((0.028, 0.045), (0.028, 0.045), (-0.024, 0.024), 0.16, _YELLOW)
    ),
    # A toy builder's ramp of beech, its slope towards the robot.
    "wedge": GraspObject(
        height_m=0.080,
        parts=(_prism(np.array([[0.035, -0.04], [-0.035, -0.04], [0.035, 0.04]]), 0.045, 1, 0.10, _WOOD),),
    ),
}
"""The benchmark's extended set, upright only."""


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
