"""Inverse kinematics of the Z1 within its joint limits, and postures: roll, pitch, yaw, x, y, z with R = Rz·Ry·Rx."""

from __future__ import annotations

import numpy as np

from hal.base import z1
from hal.base.transforms import inverse
from hal.base.z1_model import ForwardKinematics

# Solutions on a joint limit come out of the closed form with rounding errors; they are clipped back afterwards.
_LIMIT_TOLERANCE_RAD = 1e-6


class PivotKinematics:
    """Forward and inverse kinematics of the gripper pivot; one object belongs to one thread."""

    def __init__(self) -> None:
        self._forward = ForwardKinematics()
        self._T_pivot_flange = inverse(z1.T_FLANGE_PIVOT)

    def forward(self, q: np.ndarray) -> np.ndarray:
        """Return T_base_pivot (4, 4) at arm joints `q` (6,) [rad]."""
        return self._forward.pivot(q)

    def inverse(
        self, T_base_pivot: np.ndarray, q_near: np.ndarray, max_change_rad: float = np.inf
    ) -> np.ndarray | None:
        """Return the joints (6,) [rad] of a pivot pose; see `solve_flange_pose`."""
        return solve_flange_pose(T_base_pivot @ self._T_pivot_flange, q_near, max_change_rad)


def solve_flange_pose(
    T_base_flange: np.ndarray, q_near: np.ndarray, max_change_rad: float = np.inf
) -> np.ndarray | None:
    """Return the joints (6,) [rad] within the limits that put the flange at `T_base_flange` (4, 4), or None.

    Args:
        T_base_flange: pose to reach.
        q_near: (6,) joints [rad]; of several solutions the one with the smallest maximum change from it is taken.
        max_change_rad: maximum change of any joint from `q_near` [rad].
    """
    from ssik.prebuilt.unitree import z1_ik  # lazy: it compiles itself on import

    q_min, q_max = z1.Q_MIN[: z1.N_ARM], z1.Q_MAX[: z1.N_ARM]
    low, high = q_min - _LIMIT_TOLERANCE_RAD, q_max + _LIMIT_TOLERANCE_RAD
    found = [solution.q for solution in z1_ik.solve(T_base_flange)]
    found = [q for q in found if (q >= low).all() and (q <= high).all()]
    if not found:
        return None
    nearest = min(found, key=lambda q: float(np.abs(q - q_near).max()))
    if np.abs(nearest - q_near).max() > max_change_rad:
        return None
    return np.clip(nearest, q_min, q_max)


def pose_from_posture(posture: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of a posture (6,) [rad, m]."""
    roll, pitch, yaw, *position = posture
    cr, sr, cp, sp, cy, sy = (f(angle) for angle in (roll, pitch, yaw) for f in (np.cos, np.sin))
    T = np.eye(4)
    T[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    T[:3, 3] = position
    return T


def posture_from_pose(T: np.ndarray) -> np.ndarray:
    """Return the posture (6,) [rad, m] of a pose (4, 4)."""
    pitch = np.arctan2(-T[2, 0], np.hypot(T[0, 0], T[1, 0]))
    return np.array([np.arctan2(T[2, 1], T[2, 2]), pitch, np.arctan2(T[1, 0], T[0, 0]), *T[:3, 3]])
