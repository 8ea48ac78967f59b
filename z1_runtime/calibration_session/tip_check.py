"""Tip check: the closed jaws' tip is moved over corners of the board, an end-to-end test of a hand-eye calibration.

One frame gives the board's pose; every corner is then an independent prediction of the tip's position.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.board.board import Board
from hal.base import z1
from hal.base.arm import ServoedArm
from hal.base.clock import Clock
from hal.base.errors import InvalidValueError
from hal.base.transforms import inverse, make_pose, transform_points
from hal.base.z1 import JAW_REACH_M, STATIONARY_FACE
from z1_runtime.calibration_session.viewpoints import plan_free_motion
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.motion.executor import Executor
from z1_runtime.motion.trajectory import MotionLimits, PathFailure, straight_move
from z1_runtime.types import JointTrajectory

T_PIVOT_TIP = make_pose(np.eye(3), np.array([JAW_REACH_M, 0.0, STATIONARY_FACE[0, 1]]))
"""(4, 4) tip of the closed jaws, in the middle of the pads' width."""
MIN_HEIGHT_M = 0.001
"""Minimum height of the tip above the print [m]."""

_TILTS_RAD = (0.0, 0.2, 0.4, 0.6)  # of the gripper from upright, tried in this order
_YAWS_RAD = np.linspace(-np.pi, np.pi, 16, endpoint=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class TipCheckConfig:
    """Corners, heights and speed of a tip check."""

    n: int = 5
    """Number of corners: the four outermost ones first, then those between."""
    height_m: float = 0.003
    """Height of the tip above the print [m]."""
    approach_m: float = 0.05
    """Height above that at which the straight descent begins [m]."""
    speed: float = 0.25
    """Fraction of the arm's limits that motions use, in (0, 1]."""

    def __post_init__(self) -> None:
        if not (self.n >= 1 and MIN_HEIGHT_M <= self.height_m <= 0.05 and 0.01 <= self.approach_m <= 0.2):
            raise InvalidValueError(
                f"tip check: out of range (n {self.n}, height_m {self.height_m}, approach_m {self.approach_m}; "
                "allowed from 1, "
                f"{MIN_HEIGHT_M} to 0.05 m, 0.01 to 0.2 m)."
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TipMeasurement:
    """Target and measured position of the tip at one corner."""

    corner: int
    """Index into `Board.corners_m`."""
    p_base_target: np.ndarray
    """(3,) target: `height_m` above the corner, by the calibration [m]."""
    p_base_tip: np.ndarray
    """(3,) position of the tip by the measured joints [m]."""
    failure: str = ""
    """Reason why the corner was not reached; empty while the arm is there."""


class TipCheck:
    """Motions of the tip over corners, with an arm whose lease is held.

    Args:
        arm: connected.
        clock: of the arm.
        board: on the table.
        config: corners, heights and speed.
    """

    def __init__(self, arm: ServoedArm, clock: Clock, board: Board, config: TipCheckConfig | None = None) -> None:
        self._arm = arm
        self._board = board
        self._config = config or TipCheckConfig()
        self._kinematics = Kinematics()
        self._executor = Executor(arm, clock)
        self._limits = MotionLimits.at_speed(self._config.speed)

    def run(self, T_base_board: np.ndarray, checker: CollisionChecker) -> Iterator[TipMeasurement]:
        """Yield each corner while the tip is over it, to be measured before the iteration continues.

        Args:
            T_base_board: (4, 4) pose of the board by the calibration under test.
            checker: of collisions; the descent to the board is not checked against the scene.

        Raises:
            MotionError, HalError: the arm does not follow, or is stopped.
        """
        for corner in _sample_farthest(self._board.corners_m, self._config.n):
            p_base_corner = transform_points(T_base_board, self._board.corners_m[corner])
            # The board's z points into it
            target = p_base_corner - self._config.height_m * T_base_board[:3, 2]
            motions = self._plan(target, -T_base_board[:3, 2], checker)
            if motions is None:
                failure = "no inverse kinematics solution, or every motion is blocked"
                yield TipMeasurement(
                    corner=corner, p_base_target=target, p_base_tip=np.full(3, np.nan), failure=failure
                )
                continue
            transfer, descent, ascent = motions
            self._execute(transfer)
            self._execute(descent)
            yield TipMeasurement(corner=corner, p_base_target=target, p_base_tip=self._tip())
            self._execute(ascent)

    def _plan(
        self, target: np.ndarray, up: np.ndarray, checker: CollisionChecker
    ) -> tuple[JointTrajectory, JointTrajectory, JointTrajectory] | None:
        """Return transfer, descent and ascent at `target` (3,), with the gripper as upright as possible."""
        # A command that the servo took from a measured state may be a hair beyond a limit
        q_from = np.clip(self._arm.status().q_command, z1.Q_MIN, z1.Q_MAX)
        for T_base_tip in _tip_poses(target, up):
            T_low = T_base_tip @ inverse(T_PIVOT_TIP)
            T_high = T_low.copy()
            T_high[:3, 3] += self._config.approach_m * up
            for q_arm in self._kinematics.solve(T_high):
                q_high = np.append(q_arm, z1.GRIPPER_CLOSED)
                try:
                    descent = straight_move(self._kinematics, T_high, T_low, q_high, limits=self._limits)
                    ascent = straight_move(self._kinematics, T_low, T_high, descent.q[-1], limits=self._limits)
                except PathFailure:
                    continue
                # The arm alone: the tip must come closer to the table than the gripper's margin allows
                if checker.check_posture(descent.q[-1]) is not None:
                    continue
                transfer = plan_free_motion(checker, q_from, q_high, self._limits)
                if transfer is not None:
                    return transfer, descent, ascent
        return None

    def _execute(self, motion: JointTrajectory) -> None:
        self._executor.execute(motion)
        self._executor.settle()

    def _tip(self) -> np.ndarray:
        return (self._kinematics.pivot(self._arm.read_state().q[: z1.N_ARM]) @ T_PIVOT_TIP)[:3, 3]


def _tip_poses(p_base_tip: np.ndarray, up: np.ndarray) -> Iterator[np.ndarray]:
    """Yield T_base_tip (4, 4) with the x axis, along the jaws, pointing down, at increasing tilts."""
    across = np.cross(up, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    upright = np.column_stack([-up, across, np.cross(-up, across)])
    for tilt in _TILTS_RAD:
        # Without a tilt its axis does not matter
        for azimuth in _YAWS_RAD if tilt else (0.0,):
            axis = Rotation.from_rotvec(azimuth * up).apply(across)
            for yaw in _YAWS_RAD:
                rotation = Rotation.from_rotvec(tilt * axis) * Rotation.from_rotvec(yaw * up)
                yield make_pose(rotation.as_matrix() @ upright, p_base_tip)


def _sample_farthest(points: np.ndarray, n: int) -> list[int]:
    """Return the indices of `n` of `points` (N, 3) by farthest-point sampling from the first."""
    chosen = [0]
    nearest = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(n, len(points)):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen
