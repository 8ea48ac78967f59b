"""The vendor's `Z1Model`: kinematics and dynamics of the Z1, here by pinocchio and ssik from its URDF.

Twists and wrenches are the vendor's: angular part first. A posture is roll, pitch, yaw, x, y, z with R = Rz·Ry·Rx.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports] - a .pth file leads to it

from hal.base import z1
from hal.base.z1_kinematics import pose_from_posture, posture_from_pose, solve_flange_pose
from hal.base.z1_model import rigid_body_model

ArrayLike = np.ndarray | Sequence[float]

MOUNT_M = 0.051
"""Position of the gripper's mount along link06's x axis [m] (URDF)."""
PIVOT_M = float(z1.T_FLANGE_PIVOT[0, 3]) - MOUNT_M
"""The vendor's end effector, the pivot, in the mount's frame, along x [m]."""

_MAX_CHANGE_RAD = 0.5
_SINGULAR_M = 0.1
_DAMPING = 1e-4  # regularises the least squares at singularities only
_GRAVITY_JOINT = 6  # pinocchio's index of joint6; its joint 0 is the universe
_END = 6


class Z1Model:
    """Kinematics and dynamics of the arm and its end effector.

    Args:
        endPosLocal: (3,) the end effector's origin in the mount's frame [m]; None = at the mount.
        endEffectorMass: its mass [kg].
        endEffectorCom: (3,) its centre of mass in the mount's frame [m].
        endEffectorInertia: (3, 3) its inertia about that centre [kg m²].
    """

    def __init__(
        self,
        endPosLocal: ArrayLike | None = None,
        endEffectorMass: float = 0.0,
        endEffectorCom: ArrayLike | None = None,
        endEffectorInertia: np.ndarray | None = None,
        /,
    ) -> None:
        full = rigid_body_model()
        model = pin.buildReducedModel(full, [full.getJointId("jointGripper")], pin.neutral(full))
        flange = full.frames[full.getFrameId("link06")]
        # The URDF's gripper is part of its last joint: only link06 itself stays.
        model.inertias[_GRAVITY_JOINT] = flange.placement.act(flange.inertia)
        self._T_joint6_mount = flange.placement * pin.SE3(np.eye(3), np.array([MOUNT_M, 0.0, 0.0]))
        self._model, self._T_flange_end = (
            model,
            pin.SE3(np.eye(3), np.array([MOUNT_M, 0.0, 0.0]) + _vector(endPosLocal, 3)),
        )
        self._T_joint6_end = flange.placement * self._T_flange_end
        inertia = np.zeros((3, 3)) if endEffectorInertia is None else np.asarray(endEffectorInertia, dtype=float)
        self._add(float(endEffectorMass), _vector(endEffectorCom, 3), inertia)

    @classmethod
    def with_gripper(cls) -> Z1Model:
        """Return the model of the arm with its closed gripper, by the URDF's masses; its end effector is the pivot.

        The gripper has 1.091 kg with its centre of mass 0.032 m in front of the mount, as in the low-level mode's own
        compensation. The vendor's library assumes another centre: its torques differ by 0.63 Nm on joints 2 to 4
        (measured).
        """
        made = cls(np.array([PIVOT_M, 0.0, 0.0]))
        full = rigid_body_model()
        made._model = pin.buildReducedModel(full, [full.getJointId("jointGripper")], pin.neutral(full))
        made._data = made._model.createData()
        return made

    def _add(self, mass: float, com: np.ndarray, inertia: np.ndarray) -> None:
        if mass:
            self._model.appendBodyToJoint(_GRAVITY_JOINT, pin.Inertia(mass, com, inertia), self._T_joint6_mount)
        self._data = self._model.createData()

    def addLoad(self, load: float) -> None:
        """Add a point mass `load` [kg] at the end-effector."""
        com = (self._T_joint6_mount.inverse() * self._T_joint6_end).translation
        self._add(float(load), com, np.zeros((3, 3)))

    # --- Kinematics -------------------------------------------------------------------------------------------------

    def forwardKinematics(self, q: ArrayLike, index: int = _END, /) -> np.ndarray:
        """Return the pose (4, 4) of joint `index` + 1 (0 … 5), or of the end-effector (6), in the base frame.

        Raises:
            ValueError: wrong shape of `q`, or no such index.
        """
        if not 0 <= index <= _END:
            raise ValueError(f"the index is {index}; allowed is 0 to {_END}.")
        pin.forwardKinematics(self._model, self._data, _vector(q, z1.N_ARM))
        if index == _END:
            return (self._data.oMi[_GRAVITY_JOINT] * self._T_joint6_end).homogeneous
        return self._data.oMi[index + 1].homogeneous

    def inverseKinematics(
        self, Tdes: np.ndarray, qPast: ArrayLike, checkInWorkSpace: bool = False, /
    ) -> tuple[bool, np.ndarray]:
        """Return whether the end effector reaches `Tdes` (4, 4), and the joints (6,); `qPast` when it does not.

        Of several solutions, the nearest to `qPast` (6,) is taken; without `checkInWorkSpace`, no joint may change by
        more than 0.5 rad.
        """
        past = _vector(qPast, z1.N_ARM)
        T_base_flange = np.asarray(Tdes, dtype=float) @ self._T_flange_end.inverse().homogeneous
        q = solve_flange_pose(T_base_flange, past, np.inf if checkInWorkSpace else _MAX_CHANGE_RAD)
        return (False, past) if q is None else (True, q)

    def CalcJacobian(self, q: ArrayLike, /) -> np.ndarray:
        """Return the spatial Jacobian (6, 6): J @ qd is the end-effector's twist in the base frame, angular part first,
        with the velocity of the point at the base's origin."""
        pin.computeJointJacobians(self._model, self._data, _vector(q, z1.N_ARM))
        J = pin.getJointJacobian(self._model, self._data, _GRAVITY_JOINT, pin.ReferenceFrame.WORLD)
        return np.vstack([J[3:], J[:3]])

    def solveQP(self, twist: ArrayLike, qPast: ArrayLike, dt: float, /) -> np.ndarray:
        """Return the joint speeds (6,) nearest to a spatial `twist` (6,), angular part first, from `qPast` (6,)
        within the limits on speed and, after `dt` [s], on position; singular or not."""
        q = _vector(qPast, z1.N_ARM)
        return self._solve_speeds(self.CalcJacobian(q), _vector(twist, 6), q, dt)

    def end_speeds(self, rates: np.ndarray, q: np.ndarray, dt: float) -> np.ndarray:
        """Return the joint speeds (6,) under which the posture changes at `rates` (6,), within the same limits."""
        T = self.forwardKinematics(q)
        goal = postureToHomo(homoToPosture(T) + dt * rates)
        angular = pin.log3(goal[:3, :3] @ T[:3, :3].T) / dt
        J = self.CalcJacobian(q)
        # From the velocity of the point at the origin to that of the end-effector.
        J[3:] += np.cross(J[:3], T[:3, 3], axisa=0, axisc=0)
        return self._solve_speeds(J, np.concatenate([angular, (goal[:3, 3] - T[:3, 3]) / dt]), q, dt)

    @staticmethod
    def _solve_speeds(J: np.ndarray, twist: np.ndarray, q: np.ndarray, dt: float) -> np.ndarray:
        speed = z1.DQ_MAX[: z1.N_ARM]
        low = np.clip((z1.Q_MIN[: z1.N_ARM] - q) / dt, -speed, 0.0)
        high = np.clip((z1.Q_MAX[: z1.N_ARM] - q) / dt, 0.0, speed)
        H = J.T @ J + _DAMPING**2 * np.eye(z1.N_ARM)
        qd = np.linalg.solve(H, J.T @ twist)
        if (qd >= low).all() and (qd <= high).all():
            return qd
        from scipy.optimize import lsq_linear

        A = np.vstack([J, _DAMPING * np.eye(z1.N_ARM)])
        b = np.concatenate([twist, np.zeros(z1.N_ARM)])
        # lsq_linear rejects equal bounds, as of a joint at its limit.
        return np.clip(lsq_linear(A, b, (low - 1e-9, high + 1e-9)).x, low, high)

    # --- Dynamics ---------------------------------------------------------------------------------------------------

    def inverseDynamics(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, Ftip: ArrayLike, /) -> np.ndarray:
        """Return the joint torques (6,) [Nm] of a motion under gravity while the end-effector pushes with `Ftip` (6,):
        moment [Nm], then force [N], in its own frame."""
        angles, wrench = _vector(q, z1.N_ARM), _vector(Ftip, 6)
        tau = pin.rnea(self._model, self._data, angles, _vector(qd, z1.N_ARM), _vector(qdd, z1.N_ARM)).copy()
        if wrench.any():
            pin.computeJointJacobians(self._model, self._data, angles)
            J = pin.getJointJacobian(self._model, self._data, _GRAVITY_JOINT, pin.ReferenceFrame.LOCAL)
            J_end = self._T_joint6_end.inverse().action @ J
            tau += J_end.T @ np.concatenate([wrench[3:], wrench[:3]])
        return tau

    # --- Limits -----------------------------------------------------------------------------------------------------

    def checkInSingularity(self, q: ArrayLike, /) -> bool:
        """Return whether joint 5 is within 0.1 m of joint 1's axis."""
        x, y = self.forwardKinematics(q, 4)[:2, 3]
        return bool(x * x + y * y < _SINGULAR_M**2)

    def jointProtect(self, q: ArrayLike, qd: ArrayLike, /) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and speeds (6,) clipped to their limits."""
        speed = z1.DQ_MAX[: z1.N_ARM]
        low, high = z1.Q_MIN[: z1.N_ARM], z1.Q_MAX[: z1.N_ARM]
        return np.clip(_vector(q, z1.N_ARM), low, high), np.clip(_vector(qd, z1.N_ARM), -speed, speed)

    def getJointQMax(self) -> list[float]:
        """Return the highest joint positions (6) [rad]."""
        return z1.Q_MAX[: z1.N_ARM].tolist()

    def getJointQMin(self) -> list[float]:
        """Return the lowest joint positions (6) [rad]."""
        return z1.Q_MIN[: z1.N_ARM].tolist()

    def getJointSpeedMax(self) -> list[float]:
        """Return the highest joint speeds (6) [rad/s]."""
        return z1.DQ_MAX[: z1.N_ARM].tolist()


def postureToHomo(posture: ArrayLike, /) -> np.ndarray:
    """Return the pose (4, 4) of a posture (6,)."""
    return pose_from_posture(_vector(posture, 6))


def homoToPosture(T: np.ndarray, /) -> np.ndarray:
    """Return the posture (6,) of a pose (4, 4)."""
    return posture_from_pose(np.asarray(T, dtype=float))


def _vector(values: ArrayLike | None, n: int) -> np.ndarray:
    if values is None:
        return np.zeros(n)
    vector = np.array(values, dtype=float)
    if vector.shape != (n,) or not np.isfinite(vector).all():
        raise ValueError(f"the value is {values!r}; allowed are {n} finite numbers.")
    return vector
