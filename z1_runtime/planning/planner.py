"""Walks the ranked grasps and returns the first the arm can really do, with its whole motion and why others were not.

Cheap tests go first and in batches: width, then the gripper at the grasp against table, scene and object. What is left
gets inverse kinematics, the straight approach and lift, and the way to the pre-grasp, each checked for collisions.
Only if all are refused, those out of the algebra's reach are tried again within the paper's tolerance of it.
"""

from __future__ import annotations

from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np

from hal.base import z1
from hal.base.errors import Z1Error
from hal.base.transforms import transform_points
from models.types import GraspSet
from z1_runtime.collision.scene_collision import CollisionChecker, warm_up
from z1_runtime.collision.self_collision import Problem
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping import width_estimation
from z1_runtime.grasping.beak_gripper import BeakGripper
from z1_runtime.grasping.features import measure, seen_by_box
from z1_runtime.grasping.grasp_candidates import GraspCandidates, GripperPlacement
from z1_runtime.grasping.ranking import Ranking
from z1_runtime.motion.trajectory import MotionLimits
from z1_runtime.planning.pick_motion import CandidateRejected, PickMotion, PickMotionPlanner, StageTimer
from z1_runtime.planning.planner_config import PlannerConfig
from z1_runtime.planning.reachability import ReachabilityRanker
from z1_runtime.types import GraspPlan, IkMethod, Observation, Rejection


class NoPlanError(Z1Error, RuntimeError):
    """No candidate can be executed.

    Attributes:
        rejections: why each was refused, in rank order.
    """

    default_code = "no_plan"

    def __init__(self, message: str, rejections: tuple[Rejection, ...]) -> None:
        super().__init__(message)
        self.rejections = rejections


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found:
    rank: int
    way: GripperPlacement
    motion: PickMotion
    ik_method: IkMethod


class GraspPlanner:
    """Plans picks for one arm; belongs to one thread, as its kinematics do."""

    def __init__(
        self, kinematics: Kinematics, config: PlannerConfig | None = None, limits: MotionLimits | None = None
    ) -> None:
        self.config = config or PlannerConfig()
        self.gripper = BeakGripper(self.config.beak)
        self._kinematics = kinematics
        self._limits = limits or MotionLimits()
        warm_up()
        width_estimation.warm_up()

    def ability(
        self,
        grasps: GraspSet,
        observation: Observation,
        middle: np.ndarray,
        alignments: np.ndarray,
        ranking: Ranking | None = None,
    ) -> np.ndarray:
        """Return what each of `grasps` (camera frame) is worth to this arm and gripper, (N,): the more the better.

        Args:
            grasps: with the generator's scores.
            observation: the frame they were made from.
            middle: (3,) of the object, camera frame [m].
            alignments: (N,) with a face of the object's box, in [0, 1].
            ranking: whose head and thresholds count; None has neither.
        """
        checker, candidates = self._laid_out(grasps, observation)
        middle = _standing(transform_points(observation.T_base_camera, middle), checker)
        ability = ReachabilityRanker(self._kinematics, checker, candidates, self.config)
        head = ranking.head if ranking else None
        likely = head.probability(self._measured(grasps, observation, checker, candidates)) if head else None
        wanted = ranking.wanted(alignments, grasps.scores) if ranking else None
        return ability.scores(middle, grasps.scores, alignments, likely=likely, wanted=wanted)

    def features(self, grasps: GraspSet, observation: Observation) -> np.ndarray:
        """Return what a scoring head goes by, (N, 11): the columns of `z1_runtime.grasping.features.FEATURES`.

        Args:
            grasps: camera frame, with the generator's scores.
            observation: the frame they were made from.

        Raises:
            DegenerateCloudError: the object's cloud spans no box.
        """
        return self._measured(grasps, observation, *self._laid_out(grasps, observation))

    def _laid_out(self, grasps: GraspSet, observation: Observation) -> tuple[CollisionChecker, GraspCandidates]:
        checker = CollisionChecker(self._kinematics, observation, None, self.config.collision)
        return checker, GraspCandidates(
            grasps,
            observation.T_base_camera,
            self.gripper,
            checker,
            fallback_width_m=self.config.fallback_width_m,
            chunk=len(grasps),
        )

    def _measured(
        self, grasps: GraspSet, observation: Observation, checker: CollisionChecker, candidates: GraspCandidates
    ) -> np.ndarray:
        candidates.free()  # lays all of them out
        approaches = grasps.T_camera_grasps[:, :3, 2] @ observation.T_base_camera[:3, :3].T
        alignments, middle = seen_by_box(grasps, observation)
        return measure(
            candidates,
            approaches=approaches,
            middle=_standing(transform_points(observation.T_base_camera, middle), checker),
            table=checker.table,
            alignments=alignments,
            generator=grasps.scores,
        )

    def plan(
        self, ranked: GraspSet, observation: Observation, q_start: np.ndarray, timer: StageTimer | None = None
    ) -> GraspPlan:
        """Return the plan of the first candidate that passes everything.

        Args:
            ranked: candidates in the camera frame, best first.
            observation: the frame they were made from.
            q_start: (7,) where the arm is, and was when the frame was taken [rad].
            timer: gets the time spent in the stages `collision`, `ik` and `plan`.

        Raises:
            NoPlanError: no candidate works, or `max_tried` were planned in vain; the message counts the reasons.
        """
        timer = timer or (lambda _: nullcontext())
        q_start = np.clip(q_start, z1.Q_MIN, z1.Q_MAX)
        config = self.config
        with timer("collision"):
            checker = CollisionChecker(self._kinematics, observation, q_start, config.collision)
            candidates = GraspCandidates(
                ranked, observation.T_base_camera, self.gripper, checker, fallback_width_m=config.fallback_width_m
            )
        motions = PickMotionPlanner(self._kinematics, checker, q_start, config=config, limits=self._limits, timer=timer)
        refused: dict[int, Rejection] = {}
        found = self._first_exact(candidates, motions, refused, timer)
        found = found or self._first_within_tolerance(candidates, motions, refused)
        rejections = tuple(refused.values())
        if found is None:
            raise NoPlanError(_explain(len(ranked), rejections), rejections)
        return GraspPlan(
            rank=found.rank,
            T_base_grasp=found.way.T_base_grasp,
            width_m=float(candidates.widths_m[found.rank]),
            T_base_pivot=found.way.T_base_pivot,
            ik_method=found.ik_method,
            jaw_open=found.way.jaw_open,
            jaw_contact=candidates.jaw_contact(found.rank),
            transfer=found.motion.transfer,
            approach=found.motion.approach,
            close=found.motion.close,
            lift=found.motion.lift,
            rejections=rejections,
        )

    def _first_exact(
        self, candidates: GraspCandidates, motions: PickMotionPlanner, refused: dict[int, Rejection], timer: StageTimer
    ) -> _Found | None:
        """Return the first candidate that passes with analytic joints; `refused` gets why those before did not."""
        tried = 0
        for rank in range(len(candidates)):
            with timer("collision"):
                ways = candidates.ways(rank)
            if isinstance(ways, Problem):
                refused[rank] = Rejection(rank=rank, reason=ways.reason, detail=ways.detail)
                continue
            if tried == self.config.max_tried:
                return None
            try:
                way, motion = motions.first_motion(ways)
            except CandidateRejected as refusal:
                refused[rank] = Rejection(rank=rank, reason=refusal.reason, detail=str(refusal))
                tried += refusal.reason != "ik"  # those cost a fraction of a millisecond
                continue
            return _Found(rank=rank, way=way, motion=motion, ik_method="analytic")
        return None

    def _first_within_tolerance(
        self, candidates: GraspCandidates, motions: PickMotionPlanner, refused: dict[int, Rejection]
    ) -> _Found | None:
        """Return the first candidate refused for its joints that passes where least squares puts it, and take it off
        `refused`; write there what became of the others."""
        left = self.config.max_least_squares
        for rank in [rank for rank, rejection in refused.items() if rejection.reason == "ik"]:
            ways = candidates.ways(rank)
            assert not isinstance(ways, Problem)
            for way in ways[:left]:
                left -= 1
                try:
                    near = motions.nearest(way)
                    if near is None:
                        continue
                    _, motion = motions.first_motion([near])
                except CandidateRejected as refusal:
                    refused[rank] = Rejection(rank=rank, reason=refusal.reason, detail=str(refusal))
                    continue
                del refused[rank]
                return _Found(rank=rank, way=near, motion=motion, ik_method="least_squares")
        return None


def _standing(middle: np.ndarray, checker: CollisionChecker) -> np.ndarray:
    """Return the middle (3,) of the object at half its height: of what leans to the camera only the top is seen."""
    top_m = float(np.percentile(checker.table.height_m(checker.object_points), 99.0))
    return middle + (0.5 * top_m - checker.table.height_m(middle)) * checker.table.normal


def _explain(n: int, rejections: tuple[Rejection, ...]) -> str:
    counts = Counter(rejection.reason for rejection in rejections).most_common()
    parts = [f"{count} {reason}" for reason, count in counts]
    if len(rejections) < n:
        parts.append(f"{n - len(rejections)} not tried, the search budget (max_tried) was spent")
    last = f" The best-ranked one: {rejections[0].detail}" if rejections else ""
    return f"none of {n} candidates can be executed: {', '.join(parts) or 'there were none'}.{last}"
