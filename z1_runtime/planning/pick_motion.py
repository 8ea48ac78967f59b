"""The motion of one grasp: joints for its poses, straight lines between them, and a free way to where they begin."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np

from hal.base import z1
from hal.base.errors import Z1Error
from hal.base.transforms import inverse
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.collision.self_collision import Problem
from z1_runtime.geometry.kinematics import IkFailure, Kinematics
from z1_runtime.grasping.grasp_candidates import GripperPlacement
from z1_runtime.motion.trajectory import MotionLimits, PathFailure, concatenate, gripper_move, joint_path, straight_move
from z1_runtime.planning.planner_config import PlannerConfig
from z1_runtime.types import JointTrajectory

StageTimer = Callable[[str], AbstractContextManager[None]]
"""`with timer("ik"): ...` adds the body's time to a stage."""

_HOW_FAR = ("ik", "path", "table", "self", "object", "scene")
"""Reasons for a refusal, by how far the planning came."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PickMotion:
    """The legs of a pick, each beginning at rest where the one before it ends."""

    transfer: JointTrajectory
    approach: JointTrajectory
    close: JointTrajectory
    lift: JointTrajectory


class CandidateRejected(Z1Error):
    """A way cannot be gone.

    Attributes:
        reason: as in `z1_runtime.types.Rejection`.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason


class PickMotionPlanner:
    """Plans the motion of one candidate after the other, all from the same start among the same surroundings."""

    def __init__(
        self,
        kinematics: Kinematics,
        checker: CollisionChecker,
        q_start: np.ndarray,
        *,
        config: PlannerConfig,
        limits: MotionLimits,
        timer: StageTimer,
    ) -> None:
        """Plan from `q_start` (7,) [rad]; `timer` gets the stages `ik` and `plan`."""
        self._kinematics = kinematics
        self._checker = checker
        self._q_start = q_start
        self._config = config
        self._limits = limits
        self._closing = limits.scaled(config.closing_speed_scale)
        self._timer = timer

    def first_motion(self, ways: list[GripperPlacement]) -> tuple[GripperPlacement, PickMotion]:
        """Return the first of `ways`, the flips of one grasp, that some branch of the joints can go.

        Raises:
            CandidateRejected: none can; of all the reasons, that of the one which came furthest.
        """
        furthest: tuple[int, CandidateRejected] | None = None
        for way in ways:
            for standoff_m in dict.fromkeys((self._config.standoff_m, self._config.short_standoff_m)):
                T_pre = _shifted(way.T_base_pivot, -standoff_m * way.T_base_grasp[:3, 2])
                with self._timer("ik"):
                    branches, refusal = self._branches(T_pre, way)
                if refusal is not None:
                    furthest = furthest or (0, refusal)
                for q_arm in branches:
                    try:
                        with self._timer("plan"):
                            return way, self._motion(way, T_pre, q_arm)
                    except CandidateRejected as refusal:
                        stage = _HOW_FAR.index(refusal.reason)
                        if furthest is None or stage > furthest[0]:
                            furthest = stage, refusal
                if branches:
                    break
        assert furthest is not None
        raise furthest[1]

    def nearest(self, way: GripperPlacement) -> GripperPlacement | None:
        """Return `way` moved to the nearest pose the arm reaches, or None where the algebra reaches it as it is.

        The paper's regularised least squares; it ends within 2 mm and 1° of the pose.

        Raises:
            CandidateRejected: nothing is that near.
        """
        with self._timer("ik"):
            if self._kinematics.solve(way.T_base_pivot):
                return None
            try:
                result = self._kinematics.best(way.T_base_pivot)
            except IkFailure as failure:
                raise CandidateRejected("ik", f"{failure} (least squares)") from failure
            T_base_pivot = self._kinematics.pivot(result.q)
            turn = inverse(way.T_base_pivot) @ way.T_base_touch
            return replace(way, T_base_pivot=T_base_pivot, T_base_touch=T_base_pivot @ turn)

    def _branches(self, T_pre: np.ndarray, way: GripperPlacement) -> tuple[list[np.ndarray], CandidateRejected | None]:
        """Return pre-grasp joints (6,), nearest to home first, or which of the three poses is out of reach."""
        T_lifted = _shifted(way.T_base_pivot, np.array([0.0, 0.0, self._config.lift_m]))
        branches: list[np.ndarray] = []
        for name, T in (("grasp", way.T_base_pivot), ("lifted pose", T_lifted), ("pre-grasp", T_pre)):
            branches = self._kinematics.solve(T)
            if not branches:
                x, y, z = T[:3, 3]
                return [], CandidateRejected(
                    "ik", f"no joints reach the {name}, the pivot at ({x:.3f}, {y:.3f}, {z:.3f}) m."
                )
        branches.sort(key=lambda q: float(np.sum((q - z1.Q_HOME) ** 2)))
        return branches[: self._config.max_branches], None

    def _motion(self, way: GripperPlacement, T_pre: np.ndarray, q_arm: np.ndarray) -> PickMotion:
        checker, limits = self._checker, self._limits
        q_pre = np.append(q_arm, way.jaw_open)
        T_lifted = _shifted(way.T_base_touch, np.array([0.0, 0.0, self._config.lift_m]))
        try:
            approach = straight_move(self._kinematics, T_pre, way.T_base_pivot, q_pre, way.jaw_open, limits)
            touch = straight_move(
                self._kinematics, way.T_base_pivot, way.T_base_touch, approach.q[-1], way.jaw_touch, self._closing
            )
            # The servo bounds the torque, so "closed" is where the jaws are sent, not where they end.
            close = concatenate([touch, gripper_move(touch.q[-1], z1.GRIPPER_CLOSED, self._closing)])
            lift = straight_move(self._kinematics, way.T_base_touch, T_lifted, close.q[-1], z1.GRIPPER_CLOSED, limits)
        except PathFailure as failure:
            raise CandidateRejected("path", str(failure)) from failure
        _refuse(
            checker.check_trajectory(
                approach,
                threshold_m=checker.config.scene_threshold_m,
                object_threshold_m=checker.config.object_threshold_m,
            ),
            "on the approach, ",
        )
        _refuse(checker.check_closing(close), "while closing, ")
        _refuse(checker.check_trajectory(lift, threshold_m=checker.config.scene_threshold_m), "while lifting, ")
        transfer = self._transfer(q_pre, T_pre)
        return PickMotion(transfer=transfer, approach=approach, close=close, lift=lift)

    def _transfer(self, q_pre: np.ndarray, T_pre: np.ndarray) -> JointTrajectory:
        """Return the first free way to the pre-grasp: direct, over a raised pose, or by way of home."""
        near_m = self._checker.config.transfer_threshold_m
        first: Problem | None = None
        for via in self._detours(q_pre, T_pre):
            transfer = joint_path(np.array([self._q_start, *via, q_pre]), self._limits)
            problem = self._checker.check_trajectory(transfer, threshold_m=near_m, object_threshold_m=near_m)
            if problem is None:
                return transfer
            first = first or problem
        assert first is not None
        raise CandidateRejected("path", f"every way to the pre-grasp is blocked; directly, {first.detail}")

    def _detours(self, q_pre: np.ndarray, T_pre: np.ndarray) -> Iterator[list[np.ndarray]]:
        yield []
        raised = self._kinematics.solve(_shifted(T_pre, np.array([0.0, 0.0, self._config.raise_m])))
        if raised:
            nearest = min(raised, key=lambda q: float(np.abs(q - q_pre[: z1.N_ARM]).max()))
            yield [np.append(nearest, q_pre[-1])]
        yield [np.append(z1.Q_HOME, q_pre[-1])]


def _refuse(problem: Problem | None, when: str) -> None:
    if problem is not None:
        raise CandidateRejected(problem.reason, when + problem.detail)


def _shifted(T: np.ndarray, by: np.ndarray) -> np.ndarray:
    T = T.copy()
    T[:3, 3] += by
    return T
