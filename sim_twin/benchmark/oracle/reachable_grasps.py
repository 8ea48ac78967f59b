"""Reachable grasps of an object in an exactly known scene, and the order to try them in."""

from __future__ import annotations

from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np

from hal.base import z1
from hal.base.messages import Intrinsics, RgbdFrame
from hal.base.transforms import transform_points
from models.types import Detection
from sim_twin.benchmark.oracle.candidates import SweepConfig, sweep_grasps
from sim_twin.benchmark.oracle.surface import Surface
from sim_twin.model.objects import OBJECTS
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import GRIPPER_START_RAD
from z1_runtime.collision import scene_collision
from z1_runtime.collision.planning_scene import CollisionConfig, PlanningScene
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.gripper_geometry import GripperPlacementConfig
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping import width_estimation
from z1_runtime.grasping.beak_gripper import BeakGripper, GripperPlacement
from z1_runtime.grasping.grasp_candidates import GraspCandidates
from z1_runtime.motion.trajectory import MotionLimits
from z1_runtime.planning.config import PlannerConfig
from z1_runtime.planning.pick_motion import PickMotionPlanner
from z1_runtime.planning.planner import make_plan
from z1_runtime.planning.reachability import ReachabilityRanker
from z1_runtime.types import GraspPlan, Observation, Plane, Rejection, RejectionReason

EXACT_PLANNER = PlannerConfig(
    short_standoff_m=0.04,
    max_branches=8,
    # The jaws' rubber has a friction of 1.0 in the twin, and no side of the object is occluded
    gripper=GripperPlacementConfig(occluded_margin_m=0.0, friction=0.8),
    collision=CollisionConfig(
        scene_threshold_m=0.001,
        object_threshold_m=0.002,
        transfer_threshold_m=0.003,
        table_margin_m=0.002,
        link_margin_m=0.005,
        table_noise_m=0.0,
        object_halo_m=0.0,
    ),
)
"""The planner's numbers without margins for noise, occluded sides and the camera's calibration."""

_SPACING_M = 0.002
_SIMILAR_RAD, _SIMILAR_M = 0.5, 0.03
"""Difference in direction, or in place, at which two grasps have a similarity of 0.6."""
_DUPLICATE_SIMILARITY = 0.95


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReachableGrasp:
    """One grasp, one flip, that the arm can reach."""

    placement: GripperPlacement


class GraspQueue:
    """Reachable grasps of one scene, ordered by value and by dissimilarity to the failed ones.

    Args:
        options: the reachable grasps.
        worth: (N,) expected quality of each, in [0, 1].
        n_candidates: grasps of the sweep.
        n_clear: those of them with clearance for the gripper.
        rejected: rejections of the others, by reason.
    """

    def __init__(
        self,
        find_grasps: list[ReachableGrasp],
        value: np.ndarray,
        *,
        n_candidates: int,
        n_clear: int,
        rejected: Counter[str],
    ) -> None:
        self._grasps, self._value = find_grasps, value
        self.n_candidates, self.n_clear, self.rejected = n_candidates, n_clear, rejected
        self._descriptor = np.array([_descriptor(grasp.placement) for grasp in find_grasps]).reshape(-1, 9)
        self._novelty, self._nearest = np.ones(len(find_grasps)), np.zeros(len(find_grasps))
        self._failed: list[np.ndarray] = []

    def __len__(self) -> int:
        return len(self._grasps)

    def next(self) -> ReachableGrasp | None:
        """Return the next grasp to try, or None when only copies of failed ones remain."""
        value = np.where(self._nearest < _DUPLICATE_SIMILARITY, self._value + self._novelty, -np.inf)
        if not len(value) or not np.isfinite(value.max()):
            return None
        return self._grasps[int(value.argmax())]

    def add_failure(self, grasp: ReachableGrasp) -> None:
        """Lower the value of `grasp` and of similar ones."""
        self._add_failure(_descriptor(grasp.placement))

    def with_failures(self, others: GraspQueue) -> GraspQueue:
        """Return `others` with the failures of this queue."""
        for traits in self._failed:
            others._add_failure(traits)
        return others

    def _add_failure(self, traits: np.ndarray) -> None:
        self._failed.append(traits)
        difference = self._descriptor - traits
        turned = np.sum(difference[:, :6] ** 2, axis=1) / _SIMILAR_RAD**2
        moved = np.sum(difference[:, 6:] ** 2, axis=1) / _SIMILAR_M**2
        similarity = np.exp(-0.5 * (turned + moved))
        self._nearest = np.maximum(self._nearest, similarity)
        self._novelty *= 1.0 - similarity


def _descriptor(placement: GripperPlacement) -> np.ndarray:
    """Return the descriptor (9,) of a placement: approach, the jaws' axis, and the place of the pads."""
    T = placement.T_base_grasp
    return np.concatenate([T[:3, 2], placement.T_base_pivot[:3, 1], T[:3, 3]])


class GroundTruthScene:
    """Exact scene for the planner's checks: whole surfaces in the base frame, without noise.

    Args:
        scene: the twin's.
        kinematics: of the arm.
        planner: its numbers.
        speed: fraction of the arm's limits.
    """

    def __init__(self, scene: SceneConfig, kinematics: Kinematics, planner: PlannerConfig, speed: float) -> None:
        scene_collision.warm_up()
        width_estimation.warm_up()
        self.kinematics = kinematics
        self._planner = planner
        self._surface, self._T_base_object = Surface(scene.grasp_object), scene.T_base_object()
        self._middle = self._T_base_object[:3, 3]
        self._gripper = BeakGripper(planner.gripper)
        q_home = np.append(z1.Q_HOME, GRIPPER_START_RAD)
        surroundings = PlanningScene.from_observation(self._observation(scene), None, kinematics, planner.collision)
        self._checker = CollisionChecker(kinematics, surroundings)
        self._motions = PickMotionPlanner(
            kinematics,
            self._checker,
            q_home,
            config=planner,
            limits=MotionLimits.at_speed(speed),
            timer=lambda _: nullcontext(),
        )

    def find_grasps(self, sweep: SweepConfig) -> GraspQueue:
        """Return the collision-free grasps of `sweep` that the arm can reach."""
        planner = self._planner
        grasps = sweep_grasps(self._surface, self._T_base_object, planner.gripper.contact_depth_m, sweep)
        candidates = GraspCandidates.from_grasps(
            grasps, self._checker, self._gripper, fallback_width_m=planner.fallback_width_m
        )
        ranker = ReachabilityRanker(self.kinematics, self._checker, planner)
        rejected: Counter[str] = Counter()
        found, ranks, scores, n_clear = [], [], [], 0
        for rank in range(len(candidates)):
            placed = candidates.placements(rank)
            if placed.rejection is not None:
                rejected[placed.rejection.reason] += 1
                continue
            n_clear += 1
            reachable = [(p, score) for p in placed.placements if (score := ranker.manipulability(p))]
            rejected[RejectionReason.IK] += not reachable
            for placement, score in reachable:
                found.append(ReachableGrasp(placement=placement))
                ranks.append(rank)
                scores.append(score)
        value = ranker.quality(candidates, self._middle, np.zeros(len(grasps)))
        return GraspQueue(
            found,
            value[np.array(ranks, dtype=int)] + planner.reachability.manipulability * np.array(scores),
            n_candidates=len(grasps),
            n_clear=n_clear,
            rejected=rejected,
        )

    def plan(self, grasp: ReachableGrasp) -> GraspPlan | Rejection:
        """Return the whole motion of `grasp`, or its rejection."""
        motion = self._motions.plan_first([grasp.placement])
        return motion if isinstance(motion, Rejection) else make_plan(motion)

    def _observation(self, scene: SceneConfig) -> Observation:
        """Return an observation from all sides at once; its camera frame is the base frame."""
        others = [
            transform_points(neighbour.T_base_object(), _sample_evenly(Surface(OBJECTS[neighbour.object])))
            for neighbour in scene.neighbours
        ]
        nothing = RgbdFrame(
            colour=np.zeros((1, 1, 3), np.uint8),
            depth_m=np.zeros((1, 1), np.float32),
            intrinsics=Intrinsics(width=1, height=1, fx=1.0, fy=1.0, cx=0.0, cy=0.0),
            stamp_s=0.0,
            sequence=0,
        )
        return Observation(
            frame=nothing,
            T_base_camera=np.eye(4),
            detection=Detection(label=scene.object, confidence=1.0, box_px=(0, 0, 1, 1)),
            object_points=transform_points(self._T_base_object, _sample_evenly(self._surface)),
            scene_points=np.concatenate([np.zeros((0, 3)), *others]),
            table=Plane(normal=np.array([0.0, 0.0, 1.0]), offset_m=0.0),
        )


def _sample_evenly(surface: Surface) -> np.ndarray:
    """Return points (N, 3) about 2 mm apart all over `surface`, in its own frame [m]."""
    # Four points a cell in the mean leave 2 % of the cells empty (Poisson)
    points = surface.sample(0.5 * _SPACING_M).points
    _, first = np.unique(np.floor(points / _SPACING_M).astype(int), axis=0, return_index=True)
    return points[np.sort(first)]
