"""Facts of the Unitree Z1, its gripper and our wrist mount, each with its source.

"URDF" is `z1_description` of the `example-robot-data` wheel; "wire" is the vendor's wire protocol as measured.
Tests hold the URDF, the twin and this page to the same numbers.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import files
from pathlib import Path

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
