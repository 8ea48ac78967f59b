"""Motion of one grasp: joints for its poses, straight lines between them, and a free transfer to the pre-grasp."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np

from hal.base import z1
from hal.base.transforms import inverse
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.kinematics import IkFailure, Kinematics
from z1_runtime.grasping.beak_gripper import GripperPlacement
from z1_runtime.motion.limits import MotionLimits
from z1_runtime.motion.trajectory import PathFailure, concatenate, gripper_move, joint_path, straight_move
from z1_runtime.planning.config import PlannerConfig
from z1_runtime.types import JointTrajectory, PlanningStage, Rejection, RejectionReason

StageTimer = Callable[[str], AbstractContextManager[None]]
"""`with timer("ik"): ...` adds the body's time to a stage."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PickMotion:
    """Phases of a pick with one placement, each beginning at rest where the one before it ends."""

    placement: GripperPlacement
    transfer: JointTrajectory
    approach: JointTrajectory
    close: JointTrajectory
    lift: JointTrajectory


class PickMotionPlanner:
    """Plans the motion of one candidate after the other, all from the same start in the same scene.

    Args:
        kinematics: of the arm.
        checker: of the scene.
        q_start: (7,) the arm's present joints, inside the limits [rad].
        config: stand-offs, lift and search limits.
        limits: speeds.
        timer: gets the stages `ik` and `plan`.
    """

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
        self._kinematics = kinematics
        self._checker = checker
        self._q_start = q_start
        self._config = config
        self._limits = limits
        self._closing = limits.scaled(config.closing_speed_scale)
        self._timer = timer

    def plan_first(self, placements: Sequence[GripperPlacement]) -> PickMotion | Rejection:
        """Return the motion of the first of `placements`, the flips of one grasp, that is feasible on some branch.

        Where none is, return the rejection that came furthest, in the order of `RejectionReason`.
        """
        furthest: Rejection | None = None
        for placement in placements:
            # Equal stand-offs are tried once
            for standoff_m in dict.fromkeys((self._config.standoff_m, self._config.short_standoff_m)):
                T_pre = _shift(placement.T_base_pivot, -standoff_m * placement.T_base_grasp[:3, 2])
                with self._timer("ik"):
                    branches = self._solve_branches(T_pre, placement)
                if isinstance(branches, Rejection):
                    furthest = _further(furthest, branches)
                    continue
                for q_arm in branches:
                    with self._timer("plan"):
                        motion = self._plan_branch(placement, T_pre, q_arm)
                    if isinstance(motion, PickMotion):
                        return motion
                    furthest = _further(furthest, motion)
                # The short stand-off is for poses out of reach, not for collisions
                break
        return furthest or _reject_ik("there is no placement of the gripper.")

    def nearest_reachable(self, placement: GripperPlacement) -> GripperPlacement | Rejection | None:
        """Return `placement` moved to the nearest pose that the arm reaches, or None where it has an exact solution.

        The paper's regularised least squares; it ends within 2 mm and 1° of the pose, or is rejected.
        """
        with self._timer("ik"):
            if self._kinematics.solve(placement.T_base_pivot):
                return None
            try:
                result = self._kinematics.best(placement.T_base_pivot)
            except IkFailure as failure:
                return _reject_ik(f"{failure} (least squares)")
            T_base_pivot = self._kinematics.pivot(result.q)
            # The gripper's turn while it closes is relative to the pivot, and moves with it
            turn = inverse(placement.T_base_pivot) @ placement.T_base_touch
            return replace(placement, T_base_pivot=T_base_pivot, T_base_touch=T_base_pivot @ turn)

    def _solve_branches(self, T_pre: np.ndarray, placement: GripperPlacement) -> list[np.ndarray] | Rejection:
        """Return pre-grasp joints (6,), nearest to home first, or the first of the three poses out of reach."""
        T_lifted = _shift(placement.T_base_pivot, np.array([0.0, 0.0, self._config.lift_m]))
        branches: list[np.ndarray] = []
        # The pre-grasp is last: its branches are the ones returned
        for name, T in (("grasp", placement.T_base_pivot), ("lifted pose", T_lifted), ("pre-grasp", T_pre)):
            branches = self._kinematics.solve(T)
            if not branches:
                x, y, z = T[:3, 3]
                return _reject_ik(f"no joints reach the {name}, the pivot at ({x:.3f}, {y:.3f}, {z:.3f}) m.")
        branches.sort(key=lambda q: float(np.sum((q - z1.Q_HOME) ** 2)))
        return branches[: self._config.max_branches]

    def _plan_branch(self, placement: GripperPlacement, T_pre: np.ndarray, q_arm: np.ndarray) -> PickMotion | Rejection:
        q_pre = np.append(q_arm, placement.jaw_open)
        lines = self._plan_lines(placement, T_pre, q_pre)
        if isinstance(lines, Rejection):
            return lines
        approach, close, lift = lines
        config = self._checker.config
        rejection = self._checker.check_trajectory(
            approach,
            threshold_m=config.scene_threshold_m,
            object_threshold_m=config.object_threshold_m,
            stage=PlanningStage.APPROACH,
        )
        rejection = rejection or self._checker.check_closing(close)
        # The lift leaves the object out, which is held and moves along
        rejection = rejection or self._checker.check_trajectory(
            lift, threshold_m=config.scene_threshold_m, stage=PlanningStage.LIFT
        )
        if rejection is not None:
            return rejection
        # Last: a transfer to a grasp without approach or lift would be planned in vain
        transfer = self._plan_transfer(q_pre, T_pre)
        if isinstance(transfer, Rejection):
            return transfer
        return PickMotion(placement=placement, transfer=transfer, approach=approach, close=close, lift=lift)

    def _plan_lines(
        self, placement: GripperPlacement, T_pre: np.ndarray, q_pre: np.ndarray
    ) -> tuple[JointTrajectory, JointTrajectory, JointTrajectory] | Rejection:
        """Return approach, closing and lift, or the rejection of the first that leaves the joint limits."""
        kinematics, limits = self._kinematics, self._limits
        T_grasp, T_touch = placement.T_base_pivot, placement.T_base_touch
        T_lifted = _shift(T_touch, np.array([0.0, 0.0, self._config.lift_m]))
        stage = PlanningStage.APPROACH
        try:
            approach = straight_move(kinematics, T_pre, T_grasp, q_pre, placement.jaw_open, limits)
            stage = PlanningStage.CLOSE
            touch = straight_move(kinematics, T_grasp, T_touch, approach.q[-1], placement.jaw_touch, self._closing)
            # The servo bounds the torque, so "closed" is the jaws' command, not their final angle.
            close = concatenate([touch, gripper_move(touch.q[-1], z1.GRIPPER_CLOSED, self._closing)])
            stage = PlanningStage.LIFT
            lift = straight_move(kinematics, T_touch, T_lifted, close.q[-1], z1.GRIPPER_CLOSED, limits)
        except PathFailure as failure:
            return Rejection(reason=RejectionReason.PATH, stage=stage, detail=str(failure))
        return approach, close, lift

    def _plan_transfer(self, q_pre: np.ndarray, T_pre: np.ndarray) -> JointTrajectory | Rejection:
        """Return the first free transfer to the pre-grasp: direct, over a raised pose, or via home."""
        threshold_m = self._checker.config.transfer_threshold_m
        blocked: list[str] = []
        for via in self._detours(q_pre, T_pre):
            transfer = joint_path(np.array([self._q_start, *via, q_pre]), self._limits)
            rejection = self._checker.check_trajectory(
                transfer, threshold_m=threshold_m, object_threshold_m=threshold_m
            )
            if rejection is None:
                return transfer
            blocked.append(rejection.detail)
        detail = f"every transfer to the pre-grasp is blocked; directly, {blocked[0]}"
        return Rejection(reason=RejectionReason.PATH, stage=PlanningStage.TRANSFER, detail=detail)

    def _detours(self, q_pre: np.ndarray, T_pre: np.ndarray) -> Iterator[list[np.ndarray]]:
        """Yield the joints (7,) between start and pre-grasp."""
        yield []
        raised = self._kinematics.solve(_shift(T_pre, np.array([0.0, 0.0, self._config.raise_m])))
        if raised:
            nearest = min(raised, key=lambda q: float(np.abs(q - q_pre[: z1.N_ARM]).max()))
            yield [np.append(nearest, q_pre[-1])]
        yield [np.append(z1.Q_HOME, q_pre[-1])]


def _further(furthest: Rejection | None, other: Rejection) -> Rejection:
    """Return the rejection that came further; of equals the first."""
    return other if furthest is None or other.reason.progress > furthest.reason.progress else furthest


def _reject_ik(detail: str) -> Rejection:
    return Rejection(reason=RejectionReason.IK, stage=PlanningStage.IK, detail=detail)


def _shift(T: np.ndarray, by: np.ndarray) -> np.ndarray:
    T = T.copy()
    T[:3, 3] += by
    return T
