"""Search for the first candidate with a feasible motion, with the rejections of those before it.

Cheap tests go first and in batches: width, then the gripper at the grasp against table, scene and object. The rest
gets inverse kinematics, the straight approach and lift, and the transfer to the pre-grasp, each checked for collisions.
Only if all are rejected, poses without an analytic solution are tried again within the paper's tolerance.
"""

from __future__ import annotations

from collections import Counter
from contextlib import nullcontext
from dataclasses import replace

import numpy as np

from hal.base import z1
from hal.base.errors import Z1Error
from z1_runtime.collision import scene_collision
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping import width_estimation
from z1_runtime.grasping.grasp_candidates import GraspCandidates
from z1_runtime.motion.limits import MotionLimits
from z1_runtime.planning.config import PlannerConfig
from z1_runtime.planning.pick_motion import PickMotion, PickMotionPlanner, StageTimer
from z1_runtime.types import GraspPlan, IkMethod, Rejection, RejectionReason


class NoPlanError(Z1Error, RuntimeError):
    """No candidate is feasible.

    Attributes:
        rejections: one for each candidate that was tried, in rank order.
    """

    default_code = "no_plan"

    def __init__(self, message: str, rejections: tuple[Rejection, ...], *, code: str | None = None) -> None:
        super().__init__(message, code=code)
        self.rejections = rejections


class GraspPlanner:
    """Plans picks for one arm; belongs to one thread, as its kinematics do."""

    def __init__(
        self, kinematics: Kinematics, config: PlannerConfig | None = None, limits: MotionLimits | None = None
    ) -> None:
        self.config = config or PlannerConfig()
        self._kinematics = kinematics
        self._limits = limits or MotionLimits()
        warm_up()

    def plan(self, candidates: GraspCandidates, q_start: np.ndarray, timer: StageTimer | None = None) -> GraspPlan:
        """Return the plan of the first candidate that passes every check.

        Args:
            candidates: first to try first.
            q_start: (7,) the arm's joints, as in the frame [rad]. They are clipped to the limits: the servo rejects a
                start that is not near its own command.
            timer: gets the time spent in the stages `collision`, `ik` and `plan`.

        Raises:
            NoPlanError: no candidate is feasible, or `max_tried` were planned in vain; the message counts the reasons.
        """
        search = _Search(
            candidates,
            PickMotionPlanner(
                self._kinematics,
                CollisionChecker(self._kinematics, candidates.scene),
                np.clip(q_start, z1.Q_MIN, z1.Q_MAX),
                config=self.config,
                limits=self._limits,
                timer=timer or _untimed,
            ),
            self.config,
            timer or _untimed,
        )
        plan = search.try_analytic() or search.try_least_squares()
        if plan is None:
            rejections = tuple(search.rejections.values())
            raise NoPlanError(_explain(len(candidates), rejections), rejections)
        return plan


def warm_up() -> None:
    """Load compiled kernels and meshes, so that the first plan is as fast as the next."""
    scene_collision.warm_up()
    width_estimation.warm_up()


class _Search:
    """One walk through the candidates."""

    def __init__(
        self, candidates: GraspCandidates, motions: PickMotionPlanner, config: PlannerConfig, timer: StageTimer
    ) -> None:
        self.rejections: dict[int, Rejection] = {}
        """By rank."""
        self._candidates = candidates
        self._motions = motions
        self._config = config
        self._timer = timer

    def try_analytic(self) -> GraspPlan | None:
        """Return the plan of the first candidate that passes with analytic joints."""
        n_tried = 0
        for rank in range(len(self._candidates)):
            with self._timer("collision"):
                found = self._candidates.placements(rank)
            if found.rejection is not None:
                self.rejections[rank] = found.rejection
                continue
            # Tested here, since candidates without a placement do not count: their motion is not planned
            if n_tried == self._config.max_tried:
                return None
            motion = self._motions.plan_first(found.placements)
            if isinstance(motion, PickMotion):
                return self._make_plan(rank, motion, "analytic")
            self._reject(rank, motion)
            n_tried += motion.reason is not RejectionReason.IK  # those cost a fraction of a millisecond
        return None

    def try_least_squares(self) -> GraspPlan | None:
        """Return the plan of the first candidate without joints that passes within the tolerance of least squares."""
        n_left = self._config.max_least_squares
        without_joints = [rank for rank, each in self.rejections.items() if each.reason is RejectionReason.IK]
        for rank in without_joints:
            for placement in self._candidates.placements(rank).placements[:n_left]:
                n_left -= 1
                nearest = self._motions.nearest_reachable(placement)
                # The grasp has joints: its lifted pose or its pre-grasp was out of reach
                if nearest is None:
                    continue
                motion = nearest if isinstance(nearest, Rejection) else self._motions.plan_first([nearest])
                if isinstance(motion, PickMotion):
                    # It was rejected in the first pass, for want of analytic joints
                    del self.rejections[rank]
                    return self._make_plan(rank, motion, "least_squares")
                self._reject(rank, motion)
        return None

    def _reject(self, rank: int, rejection: Rejection) -> None:
        self.rejections[rank] = replace(rejection, rank=rank)

    def _make_plan(self, rank: int, motion: PickMotion, ik_method: IkMethod) -> GraspPlan:
        return make_plan(motion, rank=rank, ik_method=ik_method, rejections=tuple(self.rejections.values()))


def make_plan(
    motion: PickMotion,
    *,
    rank: int = 0,
    ik_method: IkMethod = "analytic",
    rejections: tuple[Rejection, ...] = (),
) -> GraspPlan:
    """Return the plan that executes `motion`."""
    placement = motion.placement
    return GraspPlan(
        rank=rank,
        T_base_grasp=placement.T_base_grasp,
        width_m=placement.width_m,
        T_base_pivot=placement.T_base_pivot,
        ik_method=ik_method,
        jaw_open=placement.jaw_open,
        jaw_contact=placement.jaw_contact,
        transfer=motion.transfer,
        approach=motion.approach,
        close=motion.close,
        lift=motion.lift,
        rejections=rejections,
    )


def _untimed(_: str) -> nullcontext[None]:
    return nullcontext()


def _explain(n: int, rejections: tuple[Rejection, ...]) -> str:
    """Return the message of a `NoPlanError`: counts by reason, and the best-ranked rejection in full."""
    counts = Counter(rejection.reason for rejection in rejections).most_common()
    parts = [f"{count} {reason}" for reason, count in counts]
    if len(rejections) < n:
        parts.append(f"{n - len(rejections)} not tried, the search budget (max_tried) was spent")
    message = f"none of {n} candidates can be executed: {', '.join(parts) or 'there were none'}."
    if not rejections:
        return message
    first = rejections[0]
    return f"{message} The best-ranked one failed at the stage {first.stage}: {first.detail}"
