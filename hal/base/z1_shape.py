"""Shape of the Z1: capsules and points for 500 Hz checks, and the gripper's dimensions.

The dimensions are in the plane in which the gripper closes, in the pivot frame: x towards the tips, y along the jaw's
axis. The gripper is a beak: the stationary jaw is fixed to the flange, below (−z), and the moving jaw turns about the
pivot's y axis. Both were measured from the collision meshes (STL) of the Z1's description; a test compares them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.base import z1


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
T_FLANGE_STATIONARY_JAW = z1.T_FLANGE_PIVOT @ T_PIVOT_STATIONARY_JAW
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
    T_pivot_camera = np.linalg.inv(z1.T_FLANGE_PIVOT) @ z1.T_FLANGE_CAMERA
    corners = np.array(np.meshgrid(*zip(z1.CAMERA_HOUSING_LOW, z1.CAMERA_HOUSING_HIGH, strict=True))).reshape(3, -1).T
    points = np.concatenate([jaw, corners @ T_pivot_camera[:3, :3].T + T_pivot_camera[:3, 3]])
    points.setflags(write=False)
    return points


GRIPPER_POINTS = _gripper_points()
"""(18, 3) corners of fixed jaw and camera housing, in the pivot frame [m] (STL meshes, `hal.base.z1`)."""
MOVING_JAW_POINTS = _edges((0.100, -0.009, 0.031), (0.100, 0.008, 0.031), (0.080, 0.020, 0.036), (0.040, 0.026, 0.041))
"""(8, 3) corners of the moving jaw, in the pivot frame when it is closed [m] (STL mesh)."""
MOVING_JAW_POINTS.setflags(write=False)
