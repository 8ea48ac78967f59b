"""Facts of the Unitree Z1, its gripper and our wrist mount, each with its source; and its shape for 500 Hz checks.

"URDF" is `z1_description` of the `example-robot-data` wheel; "wire" is the vendor's wire protocol as measured.
Tests hold the URDF, the twin and this page to the same numbers.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import files
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hal.base.errors import MissingFileError

JOINT_NAMES = ("joint1", "joint2", "joint3", "joint4", "joint5", "joint6", "gripper")
"""Order of every joint vector; the URDF calls the last one `jointGripper`."""
N_JOINTS = len(JOINT_NAMES)
N_ARM = 6


def _constant(*values: float) -> np.ndarray:
    array = np.array(values)
    array.setflags(write=False)
    return array


# --- Limits (URDF, `limit`) -------------------------------------------------------------------------------
Q_MIN = _constant(
    -2.6179938779914944, 0.0, -2.8797932657906435, -1.5184364492350666, -1.3439035240356338, -2.792526803190927, -1.5707
)
"""(7,) lowest joint position [rad]."""
Q_MAX = _constant(
    2.6179938779914944, 2.9670597283903604, 0.0, 1.5184364492350666, 1.3439035240356338, 2.792526803190927, 0.0
)
"""(7,) highest joint position [rad]."""
DQ_MAX = _constant(3.1415, 3.1415, 3.1415, 3.1415, 3.1415, 3.1415, 3.1415)
"""(7,) highest joint speed [rad/s]."""
TAU_MAX = _constant(30.0, 60.0, 30.0, 30.0, 30.0, 30.0, 30.0)
"""(7,) highest motor torque [Nm]; joint 2 has two motors."""

# --- Not published by the vendor; chosen so that the twin tracks within 0.02 rad --------------------
DDQ_MAX = _constant(8.0, 8.0, 8.0, 12.0, 12.0, 12.0, 12.0)
"""(7,) highest joint acceleration [rad/s²]."""
DDDQ_MAX = _constant(80.0, 80.0, 80.0, 120.0, 120.0, 120.0, 120.0)
"""(7,) highest joint jerk [rad/s³]."""

# --- Position servo of the vendor's controller in JOINTCTRL (wire: 25.6 · K_P and 0.0128 · K_W) -------------
# joint4's K_P is 25 in JOINTCTRL, TEACHREPEAT and moves to poses, and 20 in the other stiff states.
KP = 25.6 * _constant(25, 30, 20, 20, 15, 30, 5)
"""(7,) stiffness [Nm/rad]."""
KD = 0.0128 * _constant(2000, 3000, 3000, 3000, 2000, 2000, 100)
"""(7,) damping [Nm s/rad]."""
KP.setflags(write=False)
KD.setflags(write=False)

CONTROL_PERIOD_S = 0.002  # as the vendor's SDK; its maker calls the motors' RS-485 bus too slow for less (z1_sdk #8)
"""The client side of the wire runs at 500 Hz [s]."""

# --- Poses --------------------------------------------------------------------------------------------------
Q_HOME = _constant(0.0, 1.085, -0.261, -0.523, 0.0, 1.57)
"""(6,) home, the camera's viewpoint in the paper [rad]."""

# --- Gripper: a stationary jaw, and a moving jaw that turns about the pivot's y axis --------------------------
GRIPPER_OPEN = -1.5707
"""Jaw angle of the maximum opening [rad] (URDF)."""
GRIPPER_CLOSED = 0.0
"""Jaw angle at which the jaws touch [rad] (URDF)."""
T_FLANGE_PIVOT = np.array([[1.0, 0, 0, 0.100], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""(4, 4) axis of the moving jaw, the vendor's end effector: 0.051 + 0.049 m along link06's x (URDF; measured pose)."""
T_FLANGE_PIVOT.setflags(write=False)

# --- Our wrist mount -------------------------------------------------------------------------------------------


def _mount(along_m: float, above_m: float, tilt_rad: float) -> np.ndarray:
    """Pose of the left imager's optical frame on the flange.

    "Above" is the flange's +y: up at home, where joint 6 is at 90° so that the jaws open sideways.
    """
    c, s = np.cos(tilt_rad), np.sin(tilt_rad)
    right, down, forward = np.array([[0.0, 0.0, 1.0], [-s, -c, 0.0], [c, -s, 0.0]])
    T_flange_camera = np.eye(4)
    T_flange_camera[:3, :3] = np.column_stack([right, down, forward])
    T_flange_camera[:3, 3] = [along_m, above_m, 0.0]
    T_flange_camera.setflags(write=False)
    return T_flange_camera


T_FLANGE_CAMERA = _mount(along_m=0.07, above_m=0.14, tilt_rad=0.55)
"""(4, 4) nominal hand-eye transform of the mount's drawing; a calibration result replaces it on a real arm.

Measured on the ten hardest of the 81 scenario views: none touches the border of the image, and the jaws occlude at
most 23 % of the object (0.06 m, 0.10 m and 0.4 rad occlude 65 %).
"""


CAMERA_HOUSING_LOW = _constant(-0.012, -0.021, -0.0193)
"""(3,) lower corner of the D405's housing in the camera frame [m] (datasheet: 42 × 42 × 23 mm, left imager 9 mm left
of its middle and 3.7 mm behind its front glass)."""
CAMERA_HOUSING_HIGH = _constant(0.030, 0.021, 0.0037)
"""(3,) upper corner of the same [m]."""
BRACKET_FOOT = _constant(0.020, 0.030, 0.009)
"""(3,) foot of the bracket, a plate, on the flange's surface (radius 32.5 mm), flange frame [m]."""
BRACKET_HEAD = T_FLANGE_CAMERA[:3, :3] @ np.array([0.009, 0.0, -0.0220]) + T_FLANGE_CAMERA[:3, 3]
"""(3,) head of the bracket, at the housing's back, flange frame [m]."""
BRACKET_HEAD.setflags(write=False)
BRACKET_HALF_WIDTH_M = 0.015
"""Half the bracket's width, along the flange's z [m]."""


@cache
def urdf_path() -> Path:
    """Return the path of the Z1's URDF (with gripper) inside the `example-robot-data` wheel.

    Raises:
        FileNotFoundError: the wheel is not installed.
    """
    for file in files("example-robot-data") or []:
        if file.match("robots/z1_description/urdf/z1.urdf"):
            return Path(str(file.locate())).resolve()
    raise MissingFileError("z1.urdf is not in the example-robot-data wheel; run `uv sync`.")


def mesh_dir() -> Path:
    """Return the folder that holds the Z1's meshes (`collision/*.STL`, `visual/*.dae`)."""
    return urdf_path().parent.parent / "meshes"


def _polyline(*points: tuple[float, float]) -> np.ndarray:
    array = np.array(points)
    array.setflags(write=False)
    return array


STATIONARY_FACE = _polyline(
    (0.1000, -0.0090), (0.0751, -0.0090), (0.0516, -0.0177), (0.0430, -0.0188), (0.0323, -0.0185), (0.0281, -0.0163)
)
"""(K, 2) x, z of the stationary jaw's inner face, tip first [m]; the same over the pad's width."""
MOVING_FACE = _polyline(
    (0.1000, -0.0090), (0.0762, -0.0090), (0.0727, -0.0083), (0.0569, -0.0012), (0.0493, 0.0009), (0.0410, 0.0013)
)
"""(K, 2) x, z of the moving jaw's inner face when closed, tip first [m]."""
STATIONARY_BACK = _polyline(
    (0.100, -0.0248), (0.090, -0.0279), (0.080, -0.0318), (0.065, -0.0352), (0.050, -0.0363), (0.035, -0.0364)
)
"""(K, 2) x, z of the stationary jaw's outer side, tip first [m]."""
MOVING_BACK = _polyline(
    (0.100, 0.0081), (0.090, 0.0129), (0.080, 0.0177), (0.065, 0.0230), (0.050, 0.0257), (0.035, 0.0262)
)
"""(K, 2) x, z of the moving jaw's outer side when closed, tip first [m]."""
HALF_WIDTH = _polyline((0.035, 0.041), (0.060, 0.0391), (0.080, 0.0352), (0.100, 0.0307))
"""(K, 2) x, and half the width of both jaws along y there [m]."""
KNEE_RADIUS_M = 0.0767
"""Distance of both knees, where an inner face stops being flat, from the moving jaw's axis [m]."""
PALM_RADIUS_M = 0.033
"""The palm is a cylinder about the moving jaw's axis; the jaw's root reaches `ROOT_RADIUS_M` [m]."""
ROOT_RADIUS_M = 0.0335
"""Radius of palm and moving jaw's root together [m]."""
PALM_HALF_WIDTH_M = 0.041
"""Half the palm's length along y [m]."""
PAD_HALF_WIDTH_M = 0.026
"""Half the pads' width along y at the tips; 0.035 at the knees [m]."""
JAW_REACH_M = 0.100
"""Distance of the fingertips from the pivot [m]."""
WRIST_X_M, WRIST_HALF_M = (-0.100, -0.030), 0.030
"""x range, and half the height and width, of the wrist behind the palm [m]."""
T_PIVOT_STATIONARY_JAW = np.eye(4)
"""(4, 4) the stationary jaw's mesh in the pivot frame: the moving jaw's joint on the gripper's body (URDF)."""
T_PIVOT_STATIONARY_JAW[0, 3] = -0.049
T_PIVOT_STATIONARY_JAW.setflags(write=False)
T_FLANGE_STATIONARY_JAW = T_FLANGE_PIVOT @ T_PIVOT_STATIONARY_JAW
"""(4, 4) the same in the flange frame."""
T_FLANGE_STATIONARY_JAW.setflags(write=False)


def moving_jaw_pose(jaw: float | np.ndarray) -> np.ndarray:
    """Return T_pivot_moving_jaw (..., 4, 4) at jaw angle `jaw` [rad]: a turn about the pivot's y axis."""
    c, s = np.cos(jaw), np.sin(jaw)
    T_pivot_moving_jaw = np.zeros((*np.shape(jaw), 4, 4))
    T_pivot_moving_jaw[..., 0, 0] = T_pivot_moving_jaw[..., 2, 2] = c
    T_pivot_moving_jaw[..., 0, 2], T_pivot_moving_jaw[..., 2, 0] = s, -s
    T_pivot_moving_jaw[..., 1, 1] = T_pivot_moving_jaw[..., 3, 3] = 1.0
    return T_pivot_moving_jaw


class Capsule(NamedTuple):
    """All points within `radius_m` of a segment, in the frame of `link`."""

    link: str
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius_m: float


CAPSULES = (
    Capsule("link00", (0.0, 0.0, 0.0), (0.0, 0.0, 0.020), 0.060),
    Capsule("link01", (0.0, -0.033, 0.033), (0.0, 0.033, 0.033), 0.040),
    Capsule("link02", (-0.350, 0.0, 0.0), (0.0, 0.0, 0.0), 0.030),
    Capsule("link02", (-0.350, -0.028, 0.0), (-0.350, 0.028, 0.0), 0.037),
    Capsule("link02", (0.0, -0.028, 0.0), (0.0, 0.028, 0.0), 0.037),
    Capsule("link03", (0.0, -0.010, 0.0), (0.060, -0.010, 0.055), 0.036),
    Capsule("link03", (0.050, 0.0, 0.055), (0.218, 0.0, 0.055), 0.034),
    Capsule("link03", (0.218, -0.016, 0.055), (0.218, 0.0, 0.055), 0.036),
    Capsule("link04", (0.0, 0.0, 0.0), (0.070, 0.0, 0.0), 0.040),
    Capsule("link05", (0.0, 0.0, 0.0), (0.030, 0.0, 0.0), 0.040),
)
"""Fitted to the collision meshes; mesh points protrude by at most 10 mm (a test measures it)."""

_MEET = {
    "link03": ("link00", "link01"),
    "link04": ("link00", "link01", "link02"),
    "link05": ("link00", "link01", "link02"),
}
CAPSULE_PAIRS = np.array(
    [
        (i, j)
        for i, one in enumerate(CAPSULES)
        for j, other in enumerate(CAPSULES)
        if other.link in _MEET.get(one.link, ())
    ]
)
"""(P, 2) indices of the capsules that can meet; neighbours on the chain always touch."""
CAPSULE_PAIRS.setflags(write=False)
TABLE_LINKS = ("link02", "link03", "link04", "link05")
"""Links that can reach the table."""
GRIPPER_OBSTACLES = ("link00", "link01", "link02", "link03")
"""Links that gripper and camera can reach."""


def _edges(*outline: tuple[float, float, float]) -> np.ndarray:
    """Return both ends of the edges at (x, z) that reach to ±y, from rows (x, z, y) [m]."""
    return np.array([(x, side * y, z) for x, z, y in outline for side in (-1.0, 1.0)])


def _gripper_points() -> np.ndarray:
    tip, palm = [(0.100, -0.009, 0.031), (0.095, -0.024, 0.031)], [(0.0, -0.036, 0.041), (0.0, 0.033, 0.041)]
    jaw = _edges(*tip, (0.070, -0.034, 0.037), *palm)
    T_pivot_camera = np.linalg.inv(T_FLANGE_PIVOT) @ T_FLANGE_CAMERA
    corners = np.array(np.meshgrid(*zip(CAMERA_HOUSING_LOW, CAMERA_HOUSING_HIGH, strict=True))).reshape(3, -1).T
    points = np.concatenate([jaw, corners @ T_pivot_camera[:3, :3].T + T_pivot_camera[:3, 3]])
    points.setflags(write=False)
    return points


GRIPPER_POINTS = _gripper_points()
"""(18, 3) corners of fixed jaw and camera housing, in the pivot frame [m] (STL meshes, `hal.base.z1`)."""
MOVING_JAW_POINTS = _edges((0.100, -0.009, 0.031), (0.100, 0.008, 0.031), (0.080, 0.020, 0.036), (0.040, 0.026, 0.041))
"""(8, 3) corners of the moving jaw, in the pivot frame when it is closed [m] (STL mesh)."""
MOVING_JAW_POINTS.setflags(write=False)
