"""Inverse kinematics: the joints that reach a pose (ssik, else least squares), and paths on one branch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.base import z1
from hal.base.errors import Z1Error
from hal.base.transforms import check_pose, error_twist, inverse, pose_error
from hal.base.z1_model import ForwardKinematics
from z1_runtime.types import IkMethod

POSITION_TOLERANCE_M = 0.002
"""The paper's tolerance of its least-squares solution [m]."""
ROTATION_TOLERANCE_RAD = float(np.deg2rad(1.0))
"""The paper's tolerance of its least-squares solution [rad]."""
MAX_JUMP_RAD = 0.15
"""Maximum joint motion between two waypoints 5 mm apart; more is a change of branch, or a singularity [rad]."""

_ARM_MIN, _ARM_MAX = z1.Q_MIN[: z1.N_ARM], z1.Q_MAX[: z1.N_ARM]
_LIMIT_ATOL = 1e-9  # rounding of the solver at a pose whose joints are exactly at a limit
_T_PIVOT_FLANGE = inverse(z1.T_FLANGE_PIVOT)

_REGULARISATION = 1e-3  # the paper's λ, against residuals measured in units of their tolerances
_MAX_ITERATIONS = 60
_RELATIVE_DECREASE = 1e-4
_MAX_DAMPING = 1e8
_SEEDS = (
    _ARM_MIN + 0.5 * (_ARM_MAX - _ARM_MIN),
    np.array([0.0, 2.0, -1.6, 0.6, 0.0, 0.0]),
)


class IkFailure(Z1Error):
    """No joint vector reaches a pose, or a path of poses without a jump.

    Attributes:
        position_error_m: position error of the best try [m]; NaN if none was measured.
        rotation_error_rad: its angle error [rad]; NaN if none was measured.
        waypoint: index of the pose along a path, or None.
        joint: name of the joint that would jump, or None.
    """

    default_code = "ik"

    def __init__(
        self,
        message: str,
        *,
        code: str | None = None,
        position_error_m: float = float("nan"),
        rotation_error_rad: float = float("nan"),
        waypoint: int | None = None,
        joint: str | None = None,
    ) -> None:
        super().__init__(message, code=code)
        self.position_error_m = position_error_m
        self.rotation_error_rad = rotation_error_rad
        self.waypoint = waypoint
        self.joint = joint


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IkResult:
    """The joint vector chosen for a pose."""

    q: np.ndarray
    """(6,) arm joints, inside the limits [rad]."""
    n_branches: int
    """Number of analytic branches inside the limits; 0 with least squares."""
    method: IkMethod
    """How the joints were found."""
    position_error_m: float
    """Distance between the requested and the reached pose [m]."""
    rotation_error_rad: float
    """Angle between the requested and the reached pose [rad]."""


class Kinematics(ForwardKinematics):
    """The Z1's forward and inverse kinematics; base = link00, pivot = `hal.base.z1.T_FLANGE_PIVOT` on link06.

    One object belongs to one thread: pinocchio's scratch memory is inside.
    """

    def __init__(self) -> None:
        super().__init__()
        # The prebuilt solver compiles itself on import; only a planner pays for it
        from ssik.prebuilt.unitree import z1_ik

        self._analytic = z1_ik.solve

    def solve(self, T_base_pivot: np.ndarray) -> list[np.ndarray]:
        """Return every arm joint vector (6,) inside the limits that puts the pivot at `T_base_pivot` (4, 4).

        The list is empty when the pose is out of reach. Every joint's range is below 2π, so a branch has one winding.

        Raises:
            ValueError: `T_base_pivot` is not a pose.
        """
        T_base_flange = check_pose(T_base_pivot, "T_base_pivot") @ _T_PIVOT_FLANGE
        # Its rescue searches for 0.4 ms near poses where the algebra degenerates; `best` has least squares for those
        solutions = [solution.q for solution in self._analytic(T_base_flange, allow_rescue=False)]
        inside = [q for q in solutions if (q >= _ARM_MIN - _LIMIT_ATOL).all() and (q <= _ARM_MAX + _LIMIT_ATOL).all()]
        return [np.clip(q, _ARM_MIN, _ARM_MAX) for q in inside]

    def best(self, T_base_pivot: np.ndarray, q_near: np.ndarray = z1.Q_HOME) -> IkResult:
        """Return the solution that minimises ‖q − q_near‖² inside the limits (the paper's choice among branches).

        Without a branch, the nearest pose is searched by the paper's regularised least squares, in 1 to 3 ms.

        Args:
            T_base_pivot: (4, 4) pose to reach.
            q_near: (6,) posture to stay close to, the paper's q_home [rad].

        Raises:
            IkFailure: no joints within 2 mm and 1°.
            ValueError: `T_base_pivot` is not a pose.
        """
        branches = self.solve(T_base_pivot)
        if branches:
            q = min(branches, key=lambda branch: float(np.sum((branch - q_near) ** 2)))
            position_error_m, rotation_error_rad = pose_error(self.pivot(q), T_base_pivot)
            return IkResult(
                q=q,
                n_branches=len(branches),
                method="analytic",
                position_error_m=position_error_m,
                rotation_error_rad=rotation_error_rad,
            )
        return self._best_least_squares(np.asarray(T_base_pivot, dtype=np.float64), np.asarray(q_near))

    def follow(
        self, Ts_base_pivot: np.ndarray, q_start: np.ndarray, *, max_jump_rad: float = MAX_JUMP_RAD
    ) -> np.ndarray:
        """Return arm joints (N, 6) along a Cartesian path (N, 4, 4), staying on one branch from `q_start` (6,).

        Args:
            Ts_base_pivot: (N, 4, 4) poses, about 5 mm apart; the first is that of `q_start`, or one step further.
            q_start: (6,) arm joints before the first waypoint [rad].
            max_jump_rad: largest move of a joint between two waypoints [rad].

        Raises:
            IkFailure: a waypoint has no solution, or only one that jumps; it names the waypoint and the joint.
        """
        qs = np.empty((len(Ts_base_pivot), z1.N_ARM))
        q = np.asarray(q_start, dtype=np.float64)
        for i, T_base_pivot in enumerate(Ts_base_pivot):
            branches = self.solve(T_base_pivot)
            where = f"waypoint {i} of {len(qs)} ({_describe(T_base_pivot)})"
            if not branches:
                raise IkFailure(f"no joints inside the limits reach {where}.", code="waypoint_unreachable", waypoint=i)
            nearest = min(branches, key=lambda branch, q=q: float(np.abs(branch - q).max()))
            jumps = np.abs(nearest - q)
            worst = int(jumps.argmax())
            if jumps[worst] > max_jump_rad:
                joint = z1.JOINT_NAMES[worst]
                raise IkFailure(
                    f"{joint} would jump by {jumps[worst]:.3f} rad at {where}; allowed is {max_jump_rad:.3f} rad.",
                    code="branch_jump",
                    waypoint=i,
                    joint=joint,
                )
            qs[i] = q = nearest
        return qs

    def _best_least_squares(self, T_base_pivot: np.ndarray, q_near: np.ndarray) -> IkResult:
        tries: list[tuple[float, np.ndarray, float, float]] = []
        for seed in (q_near, *_SEEDS):
            q = self._least_squares(T_base_pivot, seed, q_near)
            position_error_m, rotation_error_rad = pose_error(self.pivot(q), T_base_pivot)
            # At most 1 within the paper's 2 mm and 1°
            misfit = max(position_error_m / POSITION_TOLERANCE_M, rotation_error_rad / ROTATION_TOLERANCE_RAD)
            tries.append((misfit, q, position_error_m, rotation_error_rad))
            if misfit <= 1.0:
                break
        misfit, q, position_error_m, rotation_error_rad = min(tries, key=lambda one: one[0])
        if misfit > 1.0:
            raise IkFailure(
                f"no joints inside the limits reach {_describe(T_base_pivot)}: the nearest found is "
                f"{position_error_m * 1e3:.1f} mm and {np.rad2deg(rotation_error_rad):.1f}° off; allowed is "
                f"{POSITION_TOLERANCE_M * 1e3:.0f} mm and {np.rad2deg(ROTATION_TOLERANCE_RAD):.0f}°.",
                code="unreachable",
                position_error_m=position_error_m,
                rotation_error_rad=rotation_error_rad,
            )
        return IkResult(
            q=q,
            n_branches=0,
            method="least_squares",
            position_error_m=position_error_m,
            rotation_error_rad=rotation_error_rad,
        )

    def _least_squares(self, T_base_pivot: np.ndarray, seed: np.ndarray, q_near: np.ndarray) -> np.ndarray:
        """Minimise pose error + λ‖q − q_near‖² by Levenberg-Marquardt, projected onto the joint limits."""
        q = np.clip(seed, _ARM_MIN, _ARM_MAX)
        residual = self._residual(q, T_base_pivot)
        cost = _cost(residual, q, q_near)
        damping = 1e-2
        for _ in range(_MAX_ITERATIONS):
            # In units of the tolerances, so that 2 mm weigh as much as 1°
            J = self.jacobian(q) / _TOLERANCES[:, None]
            H = J.T @ J + _REGULARISATION * np.eye(z1.N_ARM)
            downhill = J.T @ residual - _REGULARISATION * (q - q_near)
            # A joint at its limit that would go beyond it is left out of this step
            free = ~(((q <= _ARM_MIN) & (downhill < 0.0)) | ((q >= _ARM_MAX) & (downhill > 0.0)))
            if not free.any():
                break
            while damping < _MAX_DAMPING:
                H_free = H[np.ix_(free, free)]
                step = np.zeros(z1.N_ARM)
                # Marquardt's damping, in proportion to each joint's own curvature
                step[free] = np.linalg.solve(H_free + damping * np.diag(H_free.diagonal()), downhill[free])
                q_new = np.clip(q + step, _ARM_MIN, _ARM_MAX)
                residual_new = self._residual(q_new, T_base_pivot)
                cost_new = _cost(residual_new, q_new, q_near)
                if cost_new < cost:
                    break
                damping *= 8.0
            else:
                break
            converged = cost - cost_new < _RELATIVE_DECREASE * cost
            q, residual, cost, damping = q_new, residual_new, cost_new, max(damping / 8.0, 1e-9)
            if converged:
                break
        return q

    def _residual(self, q: np.ndarray, T_base_pivot: np.ndarray) -> np.ndarray:
        return error_twist(self.pivot(q), T_base_pivot) / _TOLERANCES


_TOLERANCES = np.array([POSITION_TOLERANCE_M] * 3 + [ROTATION_TOLERANCE_RAD] * 3)


def _cost(residual: np.ndarray, q: np.ndarray, q_near: np.ndarray) -> float:
    return float(residual @ residual + _REGULARISATION * np.sum((q - q_near) ** 2))


def _describe(T_base_pivot: np.ndarray) -> str:
    x, y, z = T_base_pivot[:3, 3]
    ax, ay, az = T_base_pivot[:3, 0]
    return f"the pivot pose at ({x:.3f}, {y:.3f}, {z:.3f}) m pointing along ({ax:.2f}, {ay:.2f}, {az:.2f})"
