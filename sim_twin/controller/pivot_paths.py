"""Paths of the gripper pivot, along a line and along an arc, solved one step at a time while they are followed.

A plan costs one inverse kinematics, so that it never delays an answer. Timing and faults are the vendor's (measured):
an arc sweeps the complement of its angle, so that it reaches its end only on half a circle, and three points on a line
lead straight on.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from scipy.spatial.transform import Rotation

from hal.base import z1
from hal.base.transforms import make_pose
from hal.base.z1_kinematics import PivotKinematics
from sim_twin.controller.paths import SCurve

LINE_JERK = 2.0
"""Jerk of the pivot along a line [m/s³]."""
TURN_JERK = 4.0
"""Jerk of its rotation along a line [rad/s³]; the requested speed limits it in rad/s, too."""
ARC_JERK = 10.0
"""Jerk of the pivot along an arc [m/s³]."""

# Maximum change of a joint within one step [rad]: a larger one jumps to another branch.
_MAX_CHANGE_RAD = 0.2
_MIN_TRIANGLE_M2 = 1e-6
_ENDLESS_M = 1e3  # far beyond the arm's reach


class _PivotPath(ABC):
    """Path of the pivot; from the first pose out of reach on the arm holds, as finding none takes several steps."""

    def __init__(self, kinematics: PivotKinematics, start: np.ndarray, gripper: float, profile: SCurve) -> None:
        self._kinematics, self._q, self._profile = kinematics, start, profile
        self._jaw_start, self._jaw_step = start[z1.N_ARM], gripper - start[z1.N_ARM]
        self._time_s, self._blocked = 0.0, False
        self.duration_s = profile.duration_s

    @abstractmethod
    def pose(self, s: float) -> np.ndarray:
        """Return the pose (4, 4) at `s`, 0 to 1."""

    def sample(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        s, _ = self._profile.sample(t_s)
        last, arm = self._q, None
        if not self._blocked:
            arm = self._kinematics.inverse(self.pose(s), last[: z1.N_ARM], _MAX_CHANGE_RAD)
            self._blocked = arm is None
        self._q = np.append(last[: z1.N_ARM] if arm is None else arm, self._jaw_start + s * self._jaw_step)
        elapsed_s, self._time_s = t_s - self._time_s, t_s
        speed = (self._q - last) / elapsed_s if elapsed_s > 0.0 and s < 1.0 else np.zeros(z1.N_JOINTS)
        return self._q, speed


class LinePath(_PivotPath):
    """Straight path of the pivot to a pose, turning about one axis.

    Args:
        kinematics: of the arm.
        start: (7,) joints [rad].
        goal: (4, 4) pose.
        gripper: gripper at the end [rad].
        speed: maximum speed [m/s], and of the rotation [rad/s]; above 0.
    """

    def __init__(
        self, kinematics: PivotKinematics, start: np.ndarray, goal: np.ndarray, gripper: float, speed: float
    ) -> None:
        self._first = kinematics.forward(start[: z1.N_ARM])
        self._step = goal[:3, 3] - self._first[:3, 3]
        self._turn = Rotation.from_matrix(goal[:3, :3] @ self._first[:3, :3].T).as_rotvec()
        line = SCurve(float(np.linalg.norm(self._step)), speed, LINE_JERK)
        turn = SCurve(float(np.linalg.norm(self._turn)), speed, TURN_JERK)
        super().__init__(kinematics, start, gripper, max(line, turn, key=lambda profile: profile.duration_s))

    def pose(self, s: float) -> np.ndarray:
        rotation = Rotation.from_rotvec(s * self._turn).as_matrix() @ self._first[:3, :3]
        return make_pose(rotation, self._first[:3, 3] + s * self._step)


class ArcPath(_PivotPath):
    """Arc of the pivot from its present position through a second one towards a third; it does not turn.

    Args:
        kinematics: of the arm.
        start: (7,) joints [rad].
        points: (2, 3) second and third position of the pivot on the arc [m].
        gripper: gripper at the end [rad].
        speed: maximum speed [m/s], above 0.
    """

    def __init__(
        self, kinematics: PivotKinematics, start: np.ndarray, points: np.ndarray, gripper: float, speed: float
    ) -> None:
        self._first = kinematics.forward(start[: z1.N_ARM])
        a, b, c = self._first[:3, 3], *points
        ab, ac = b - a, c - a
        normal = np.cross(ab, ac)
        size = float(np.linalg.norm(normal))
        self._line = size < _MIN_TRIANGLE_M2
        if self._line:
            self._x, length = ab / max(float(np.linalg.norm(ab)), 1e-9) * _ENDLESS_M, _ENDLESS_M
        else:
            # Circumcentre of the triangle a, b, c
            self._centre = a + (np.cross(normal, ab) * (ac @ ac) + np.cross(ac, normal) * (ab @ ab)) / (2.0 * size**2)
            self._x = a - self._centre
            self._y = np.cross(normal / size, self._x)
            ahead = c - self._centre
            self._sweep = 2.0 * np.pi - float(np.arctan2(ahead @ self._y, ahead @ self._x)) % (2.0 * np.pi)
            length = float(np.linalg.norm(self._x)) * self._sweep
        super().__init__(kinematics, start, gripper, SCurve(length, speed, ARC_JERK))

    def pose(self, s: float) -> np.ndarray:
        if self._line:
            return make_pose(self._first[:3, :3], self._first[:3, 3] + s * self._x)
        angle = s * self._sweep
        return make_pose(self._first[:3, :3], self._centre + np.cos(angle) * self._x + np.sin(angle) * self._y)
