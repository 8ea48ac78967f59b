"""The Z1's gripper in the plane in which it closes, in the pivot frame: x towards the tips, y along the jaw's axis.

The gripper is a beak: the stationary jaw is fixed to the flange, below (−z), and the moving jaw turns about the pivot's
y axis. Both were measured from the collision meshes (STL) of the Z1's description; a test compares them.
"""

from __future__ import annotations

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
