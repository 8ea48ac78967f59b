"""Points at corners of the board with the tip of the closed jaws: the end-to-end test of a hand-eye calibration.

One look gives the board's place; every corner is then an independent claim about where the tip ends up.
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
from hal.base.transforms import inverse, make_pose
from hal.base.z1_gripper import JAW_REACH_M, STATIONARY_FACE
from z1_runtime.calibration_session.viewpoints import plan_way
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.motion.executor import Executor
from z1_runtime.motion.trajectory import MotionLimits, PathFailure, straight_move
from z1_runtime.types import JointTrajectory

T_PIVOT_TIP = make_pose(np.eye(3), np.array([JAW_REACH_M, 0.0, STATIONARY_FACE[0, 1]]))
"""(4, 4) where the closed jaws meet at their tips, in the middle of the pads' width."""
MIN_HEIGHT_M = 0.001
"""The tip comes no nearer to the print than this [m]."""

_TILTS_RAD = (0.0, 0.2, 0.4, 0.6)
_YAWS_RAD = np.linspace(-np.pi, np.pi, 16, endpoint=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class TouchConfig:
    """How corners are pointed at."""

    n: int = 5
    """How many corners: the four outermost ones first, then those between."""
    height_m: float = 0.003
    """How far over the print the tip stops [m]."""
    approach_m: float = 0.05
    """How far over that the straight way down begins [m]."""
    speed: float = 0.25
    """Fraction of the arm's limits that motions use, in (0, 1]."""

    def __post_init__(self) -> None:
        if not (self.n >= 1 and MIN_HEIGHT_M <= self.height_m <= 0.05 and 0.01 <= self.approach_m <= 0.2):
            raise InvalidValueError(
                f"n is {self.n}, height_m {self.height_m}, approach_m {self.approach_m}; allowed are 1 and more, "
                f"{MIN_HEIGHT_M} to 0.05 m, and 0.01 to 0.2 m."
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Touch:
    """The tip over one corner."""

    corner: int
    """Index into `Board.corners_m`."""
    p_base_wanted: np.ndarray
    """(3,) where the tip was sent: `height_m` over the corner, by the calibration [m]."""
    p_base_tip: np.ndarray
    """(3,) where the joints say that it is [m]."""
    problem: str = ""
    """Why the corner cannot be pointed at; empty when it was, and the arm now stands there."""


class TouchTest:
    """Drives the tip over corners; for an arm whose lease is held.

    Args:
        arm: connected.
        clock: by which it lives.
        board: that lies there.
        config: how.
    """

    def __init__(self, arm: ServoedArm, clock: Clock, board: Board, config: TouchConfig | None = None) -> None:
        self._arm = arm
        self._board = board
        self._config = config or TouchConfig()
        self._kinematics = Kinematics()
        self._executor = Executor(arm, clock)
        self._limits = MotionLimits.at_speed(self._config.speed)

    def run(self, T_base_board: np.ndarray, checker: CollisionChecker) -> Iterator[Touch]:
        """Yield each corner while the tip is over it; ask, measure, then go on.

        Args:
            T_base_board: (4, 4) where the board lies, by the calibration under test.
            checker: what to keep away from; the way down to the board is not its matter.

        Raises:
            MotionError, HalError: the arm does not follow, or is stopped.
        """
        for corner in _far_apart(self._board.corners_m, self._config.n):
            p_base_corner = T_base_board[:3, :3] @ self._board.corners_m[corner] + T_base_board[:3, 3]
            wanted = p_base_corner - self._config.height_m * T_base_board[:3, 2]
            ways = self._ways(wanted, -T_base_board[:3, 2], checker)
            if ways is None:
                problem = "no joints reach it, or every way there is blocked"
                yield Touch(corner=corner, p_base_wanted=wanted, p_base_tip=np.full(3, np.nan), problem=problem)
                continue
            way, down, up = ways
            self._play(way)
            self._play(down)
            yield Touch(corner=corner, p_base_wanted=wanted, p_base_tip=self._tip())
            self._play(up)

    def _ways(
        self, wanted: np.ndarray, up: np.ndarray, checker: CollisionChecker
    ) -> tuple[JointTrajectory, JointTrajectory, JointTrajectory] | None:
        """Return the motions over `wanted` (3,), down to it and up again, upright if possible."""
        q_from = np.clip(self._arm.status().q_command, z1.Q_MIN, z1.Q_MAX)
        for T_base_tip in _postures(wanted, up):
            T_low = T_base_tip @ inverse(T_PIVOT_TIP)
            T_high = T_low.copy()
            T_high[:3, 3] += self._config.approach_m * up
            for q_arm in self._kinematics.solve(T_high):
                q_high = np.append(q_arm, z1.GRIPPER_CLOSED)
                try:
                    down = straight_move(self._kinematics, T_high, T_low, q_high, limits=self._limits)
                    up_again = straight_move(self._kinematics, T_low, T_high, down.q[-1], limits=self._limits)
                except PathFailure:
                    continue
                if checker.check_posture(down.q[-1]) is not None:
                    continue
                way = plan_way(checker, q_from, q_high, self._limits)
                if way is not None:
                    return way, down, up_again
        return None

    def _play(self, motion: JointTrajectory) -> None:
        self._executor.execute(motion)
        self._executor.settle()

    def _tip(self) -> np.ndarray:
        return (self._kinematics.pivot(self._arm.read_state().q[: z1.N_ARM]) @ T_PIVOT_TIP)[:3, 3]


def _postures(p_base_tip: np.ndarray, up: np.ndarray) -> Iterator[np.ndarray]:
    """Yield T_base_tip (4, 4) whose x axis, along the jaws, points down, or leans from that more and more."""
    aside = np.cross(up, [1.0, 0.0, 0.0])
    aside /= np.linalg.norm(aside)
    upright = np.column_stack([-up, aside, np.cross(-up, aside)])
    for tilt in _TILTS_RAD:
        for lean in _YAWS_RAD if tilt else (0.0,):
            axis = Rotation.from_rotvec(lean * up).apply(aside)
            for yaw in _YAWS_RAD:
                turn = Rotation.from_rotvec(tilt * axis) * Rotation.from_rotvec(yaw * up)
                yield make_pose(turn.as_matrix() @ upright, p_base_tip)


def _far_apart(points: np.ndarray, n: int) -> list[int]:
    """Return the indices of `n` of `points` (N, 3), each the farthest from those before, beginning at the first."""
    chosen = [0]
    nearest = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(n, len(points)):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen
