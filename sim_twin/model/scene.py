"""One validated description of a scene, and the MuJoCo model made from it."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from hal.base import z1
from hal.base.errors import InvalidValueError
from sim_twin.model.objects import OBJECT_BODY, OBJECT_NAMES, OBJECTS, add_object
from sim_twin.model.parts import GraspObject
from sim_twin.model.z1_mjcf import BIT_BASE, BIT_GRIPPER, BIT_SCENE, CONTACT_SOLIMP, CONTACT_SOLREF, GROUP_SCENE, add_z1

if TYPE_CHECKING:  # few scenes have a board
    from sim_twin.model.charuco_board import BoardSpec

PHYSICS_PERIOD_S = z1.CONTROL_PERIOD_S / 2
"""Two physics steps in a control period: contacts of 4 ms time constant need steps of 2 ms or less [s]."""
FIXTURE = "fixture"
TABLE_RGBA = (0.74, 0.66, 0.55, 1)

# Nearer, the open jaws touch the object at home; farther, or more to the side, the wrist cannot face it.
_DISTANCE_M = (0.30, 0.65)
_LATERAL_M = (-0.25, 0.25)
_PITCH_DEG = (-60.0, 60.0)
_MOUNT_ERROR_M, _MOUNT_ERROR_DEG = (0.0, 0.02), (0.0, 10.0)
_FACTOR = (0.1, 10.0)
_ARM_LATENCY_S = (0.0, 0.1)
_PARKED_XY_M = (0.90, -0.50)  # the object's place out of reach, when there is a board
_TABLE_FRICTION = (0.4, 0.005, 0.0001)


@dataclass(frozen=True, slots=True, kw_only=True)
class Neighbour:
    """An upright object next to the one to grasp.

    Raises:
        InvalidValueError: there is no such object.
    """

    object: str
    """One of `sim_twin.model.objects.OBJECT_NAMES`."""
    x_m: float
    """Its origin along base x [m]."""
    y_m: float
    """Its origin along base y [m]."""
    yaw_deg: float = 0.0
    """Turn about base z [°]."""

    def __post_init__(self) -> None:
        _check_object(self.object)

    def T_base_object(self) -> np.ndarray:
        """Return its pose (4, 4) at the start."""
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", self.yaw_deg, degrees=True).as_matrix()
        pose[:3, 3] = [self.x_m, self.y_m, OBJECTS[self.object].height_m / 2]
        return pose


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """One object, maybe among neighbours, on the table in front of the arm; or a calibration board.

    Raises:
        InvalidValueError: a field is out of its range; the message names the range.
    """

    object: str = "bottle"
    """Object on the table: a name from `sim_twin.model.objects.OBJECT_NAMES`, or the name of `shape`."""
    shape: GraspObject | None = None
    """Shape of an object that is none of the named ones."""
    distance_m: float = 0.48
    """Object's distance from the base along base x [m], at mid-height on its axis; 0.3 to 0.65."""
    lateral_m: float = 0.0
    """Object's offset along base y [m], positive to the left; −0.25 to 0.25."""
    pitch_deg: float = 0.0
    """Object's lean about base y [°], positive from the base outwards; −60 to 60. A fixture holds a leaning object."""
    seed: int = 0
    """Seed of the camera's noise."""
    noise: bool = True
    """Simulate the camera's noise; without it depth is exact (rounded to its unit) and colour clean."""
    board: BoardSpec | None = None
    """Calibration board on the table; the object is then out of reach."""
    mount_error_m: float = 0.0
    """Offset of the camera from the mount's drawing [m], 0 to 0.02; only a calibration can find it."""
    mount_error_deg: float = 0.0
    """Turn of the camera from the mount's drawing [°], 0 to 10."""
    mount_seed: int = 0
    """Seed of the directions of both mount errors."""
    neighbours: tuple[Neighbour, ...] = ()
    """Further objects on the table."""
    friction_factor: float = 1.0
    """Friction of every surface relative to its nominal value; 0.1 to 10."""
    mass_factor: float = 1.0
    """Object's mass relative to its nominal value; 0.1 to 10."""
    arm_latency_s: float = 0.0
    """Latency of the arm's motions [s], 0 to 0.1, rounded to control periods."""

    def __post_init__(self) -> None:
        if self.shape is None:
            _check_object(self.object)
        _check_range("distance_m", self.distance_m, _DISTANCE_M, "m in front of the base")
        _check_range("lateral_m", self.lateral_m, _LATERAL_M, "m to the side")
        _check_range("pitch_deg", self.pitch_deg, _PITCH_DEG, "degrees of lean")
        _check_range("mount_error_m", self.mount_error_m, _MOUNT_ERROR_M, "m")
        _check_range("mount_error_deg", self.mount_error_deg, _MOUNT_ERROR_DEG, "degrees")
        _check_range("friction_factor", self.friction_factor, _FACTOR, "times the usual")
        _check_range("mass_factor", self.mass_factor, _FACTOR, "times the usual")
        _check_range("arm_latency_s", self.arm_latency_s, _ARM_LATENCY_S, "s")
        for name in ("seed", "mount_seed"):
            seed = getattr(self, name)
            # A bool is an int in Python
            if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**32:
                raise InvalidValueError(
                    f"scene: {name} is invalid ({seed!r}, allowed whole numbers from 0 to {2**32 - 1}). Give such "
                    "a seed.",
                    code="scene_seed",
                )

    @property
    def grasp_object(self) -> GraspObject:
        """The object's shape."""
        return OBJECTS[self.object] if self.shape is None else self.shape

    @property
    def is_held(self) -> bool:
        """True where a break-away fixture holds the object: it leans, or is unstable upright."""
        return self.pitch_deg != 0 or not self.grasp_object.is_stable

    def T_base_object(self) -> np.ndarray:
        """Return the object's pose (4, 4) at the start, its lowest point on the table."""
        pitch = np.deg2rad(self.pitch_deg)
        c, s = np.cos(pitch), np.sin(pitch)
        pose = np.eye(4)
        pose[:3, :3] = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
        lowest = (self.grasp_object.corners() @ pose[2, :3]).min()
        where = _PARKED_XY_M if self.board is not None else (self.distance_m, self.lateral_m)
        pose[:3, 3] = [*where, -lowest]
        return pose

    def T_flange_camera(self) -> np.ndarray:
        """Return the camera's true pose on the flange (4, 4)."""
        # Normal vectors brought to unit length have no preferred direction
        shift, turn = np.random.default_rng(self.mount_seed).normal(size=(2, 3))
        pose = z1.T_FLANGE_CAMERA.copy()
        pose[:3, 3] += self.mount_error_m * shift / np.linalg.norm(shift)
        rotvec = np.deg2rad(self.mount_error_deg) * turn / np.linalg.norm(turn)
        pose[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix() @ pose[:3, :3]
        return pose

    def camera_serial(self) -> str:
        """Return the camera's serial number: one per mount, so that no calibration is used for another mount."""
        if not (self.mount_error_m or self.mount_error_deg):
            return "twin"
        return f"twin-{1e3 * self.mount_error_m:g}mm-{self.mount_error_deg:g}deg-{self.mount_seed}"


def _check_object(name: str) -> None:
    if name not in OBJECT_NAMES:
        raise InvalidValueError(
            f"scene: the object is unknown ({name!r}, allowed {', '.join(OBJECT_NAMES)}). Choose one of these.",
            code="unknown_object",
        )


def _check_range(name: str, value: float, allowed: tuple[float, float], unit: str) -> None:
    if not (isinstance(value, int | float) and allowed[0] <= value <= allowed[1]):  # NaN fails too
        raise InvalidValueError(
            f"scene: {name} is out of range ({value!r}, allowed {allowed[0]:g} to {allowed[1]:g} {unit}). Give a value "
            "within the range.",
            code="scene_range",
        )


def neighbour_body(number: int) -> str:
    """Return the name of the body of the neighbour of that number, from 0."""
    return f"neighbour_{number}"


def build_model(config: SceneConfig) -> mujoco.MjModel:
    """Return the model of arm, table, object and, if there are any, neighbours and board; it is the caller's own."""
    # A copy, as each world writes its servos' gains into its model
    return copy.copy(_compile(config))


@lru_cache(maxsize=2)  # an episode builds its scene several times; compiling the arm's meshes takes 0.2 s
def _compile(config: SceneConfig) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    # The URDF's limits are in radians; MuJoCo's compiler takes degrees by default
    spec.compiler.degree = False
    _set_options(spec)
    _add_surroundings(spec)
    add_z1(spec, config.T_flange_camera())
    if config.board is not None:
        from sim_twin.model.charuco_board import add_board

        add_board(spec, config.board)
    add_object(spec, config.grasp_object, config.T_base_object(), mass_factor=config.mass_factor)
    for number, neighbour in enumerate(config.neighbours):
        add_object(spec, OBJECTS[neighbour.object], neighbour.T_base_object(), name=neighbour_body(number))
    if config.is_held:
        weld = spec.add_equality(name=FIXTURE, type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY)
        weld.name1, weld.name2 = OBJECT_BODY, "world"
        weld.data = [0.0] * 10 + [1.0, 0.0]  # anchor and relative pose left to the compiler; torque scale 1 m
    model = spec.compile()
    # On every geom: MuJoCo uses one of the two in contact, by priority or the larger
    model.geom_friction *= config.friction_factor
    return model


def _set_options(spec: mujoco.MjSpec) -> None:
    option = spec.option
    option.timestep = PHYSICS_PERIOD_S
    # Implicit in velocities: joint damping and the servos' derivative gains stay stable at steps of 1 ms
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Held objects creep by the softness of friction: stiff friction rows slow that, the no-slip pass ends it (0.06 mm
    # and 0.03° in 3 s, against 1.3 mm and 2.6° without).
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    option.noslip_iterations = 4
    option.iterations = 30
    spec.stat.extent, spec.stat.center = 1.0, [0.3, 0.0, 0.2]
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 20.0
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.30, 0.30, 0.32], [0.25, 0.25, 0.25]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    spec.visual.quality.shadowsize, spec.visual.map.shadowclip = 2048, 1.0


def _add_surroundings(spec: mujoco.MjSpec) -> None:
    texture, builtin = mujoco.mjtTexture, mujoco.mjtBuiltin
    spec.add_texture(
        name="sky",
        type=texture.mjTEXTURE_SKYBOX,
        builtin=builtin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.95, 0.97],
        rgb2=[0.55, 0.66, 0.78],
        width=256,
        height=1536,
    )
    spec.add_texture(
        name="floor",
        type=texture.mjTEXTURE_2D,
        builtin=builtin.mjBUILTIN_CHECKER,
        rgb1=[0.44, 0.46, 0.49],
        rgb2=[0.48, 0.50, 0.53],
        width=256,
        height=256,
    )
    floor = spec.add_material(name="floor", texrepeat=[8, 8], texuniform=False, specular=0.1, shininess=0.1)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    for name, rgba, specular in (
        ("table", TABLE_RGBA, 0.15),
        ("link", (0.86, 0.88, 0.91, 1), 0.5),
        ("dark", (0.20, 0.22, 0.26, 1), 0.5),
        ("jaw", (0.15, 0.16, 0.19, 1), 0.4),
        ("camera", (0.62, 0.64, 0.67, 1), 0.6),
        ("bracket", (0.10, 0.10, 0.11, 1), 0.3),
    ):
        spec.add_material(name=name, rgba=rgba, specular=specular, shininess=0.4)
    world = spec.worldbody
    sun = world.add_light(name="sun", pos=[-0.3, -1.2, 2.2], dir=[0.35, 0.7, -1.0], castshadow=True)
    sun.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    sun.diffuse, sun.specular, sun.ambient = [0.62, 0.60, 0.56], [0.25, 0.25, 0.25], [0.0, 0.0, 0.0]
    common = {"group": GROUP_SCENE, "type": mujoco.mjtGeom.mjGEOM_BOX}
    world.add_geom(
        name="floor", pos=[0, 0, -0.76], size=[4, 4, 0.01], contype=0, conaffinity=0, material="floor", **common
    )
    world.add_geom(
        name="table",
        pos=[0.35, 0.0, -0.02],
        size=[0.65, 0.60, 0.02],
        contype=BIT_SCENE,
        conaffinity=BIT_SCENE | BIT_BASE | BIT_GRIPPER,
        friction=_TABLE_FRICTION,
        solref=CONTACT_SOLREF,
        solimp=CONTACT_SOLIMP,
        material="table",
        **common,
    )
