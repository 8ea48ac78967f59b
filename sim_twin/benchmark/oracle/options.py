"""Ways to grasp an object in a scene that is known exactly, and which of them to try next."""

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
from z1_runtime.collision.collision_config import CollisionConfig
from z1_runtime.collision.planning_scene import PlanningScene
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.gripper_geometry import BeakConfig
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping import width_estimation
from z1_runtime.grasping.beak_gripper import BeakGripper, GripperPlacement
from z1_runtime.grasping.grasp_candidates import GraspCandidates
from z1_runtime.motion.trajectory import MotionLimits
from z1_runtime.planning.pick_motion import PickMotionPlanner
from z1_runtime.planning.planner import make_plan
from z1_runtime.planning.planner_config import PlannerConfig
from z1_runtime.planning.reachability import ReachabilityRanker
from z1_runtime.types import GraspPlan, Observation, Plane, Rejection, RejectionReason

EXACT_PLANNER = PlannerConfig(
    short_standoff_m=0.04,
    max_branches=8,
    # The jaws' rubber has a friction of 1.0 in the twin, and no side of the object is unseen
    gripper=BeakConfig(unseen_m=0.0, friction=0.8),
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
"""The planner's numbers without what they allow for noise, unseen sides and the camera's calibration."""

_SPACING_M = 0.002
_ALIKE_RAD, _ALIKE_M = 0.5, 0.03
"""Ways that differ by this much in direction, or in place, are alike by 0.6."""
_A_COPY = 0.95


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Option:
    """One grasp, one flip, that the arm can go."""

    way: GripperPlacement


class Options:
    """Ways of one scene; hands out the best of those least like what failed.

    Args:
        options: what can be gone.
        worth: (N,) how well each should hold, in [0, 1].
        n_candidates: grasps they were found among.
        n_clear: those of them with room for the gripper.
        rejected: why the others are out, by reason.
    """

    def __init__(
        self, options: list[Option], worth: np.ndarray, *, n_candidates: int, n_clear: int, rejected: Counter[str]
    ) -> None:
        self._options, self._worth = options, worth
        self.n_candidates, self.n_clear, self.rejected = n_candidates, n_clear, rejected
        self._traits = np.array([_traits(option.way) for option in options]).reshape(-1, 9)
        self._hope, self._nearest = np.ones(len(options)), np.zeros(len(options))
        self._failed: list[np.ndarray] = []

    def __len__(self) -> int:
        return len(self._options)

    def next(self) -> Option | None:
        """Return the one to try next, or None when all that is left are copies of what failed."""
        value = np.where(self._nearest < _A_COPY, self._worth + self._hope, -np.inf)
        if not len(value) or not np.isfinite(value.max()):
            return None
        return self._options[int(value.argmax())]

    def fail(self, option: Option) -> None:
        """Set back `option` and all that is like it."""
        self._mark(_traits(option.way))

    def joined(self, others: Options) -> Options:
        """Return `others` with the failures known here."""
        for traits in self._failed:
            others._mark(traits)
        return others

    def _mark(self, traits: np.ndarray) -> None:
        self._failed.append(traits)
        apart = self._traits - traits
        turned = np.sum(apart[:, :6] ** 2, axis=1) / _ALIKE_RAD**2
        moved = np.sum(apart[:, 6:] ** 2, axis=1) / _ALIKE_M**2
        alike = np.exp(-0.5 * (turned + moved))
        self._nearest = np.maximum(self._nearest, alike)
        self._hope *= 1.0 - alike


def _traits(way: GripperPlacement) -> np.ndarray:
    """Return what makes a way another: approach, the jaws' axis, and where the pads press (9,)."""
    T = way.T_base_grasp
    return np.concatenate([T[:3, 2], way.T_base_pivot[:3, 1], T[:3, 3]])


class TrueScene:
    """What stands in a scene, as the planner's checks want it: whole surfaces in the base frame, without noise.

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
        self._surface, self._T_base_object = Surface(scene.thing), scene.T_base_object()
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

    def options(self, sweep: SweepConfig) -> Options:
        """Return the ways that hit nothing and that the arm can go, of the grasps of `sweep`."""
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
            gone = [(way, score) for way in placed.placements if (score := ranker.manipulability(way))]
            rejected[RejectionReason.IK] += not gone
            for way, score in gone:
                found.append(Option(way=way))
                ranks.append(rank)
                scores.append(score)
        worth = ranker.quality(candidates, self._middle, np.zeros(len(grasps)))
        return Options(
            found,
            worth[np.array(ranks, dtype=int)] + planner.reachability.manipulability * np.array(scores),
            n_candidates=len(grasps),
            n_clear=n_clear,
            rejected=rejected,
        )

    def plan(self, option: Option) -> GraspPlan | Rejection:
        """Return the whole motion of `option`, or the rejection of it."""
        motion = self._motions.plan_first([option.way])
        return motion if isinstance(motion, Rejection) else make_plan(motion)

    def _observation(self, scene: SceneConfig) -> Observation:
        """Return the scene as if it had been seen from all sides at once; its camera frame is the base frame."""
        others = [
            transform_points(neighbour.T_base_object(), _even_points(Surface(OBJECTS[neighbour.object])))
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
            object_points=transform_points(self._T_base_object, _even_points(self._surface)),
            scene_points=np.concatenate([np.zeros((0, 3)), *others]),
            table=Plane(normal=np.array([0.0, 0.0, 1.0]), offset_m=0.0),
        )


def _even_points(surface: Surface) -> np.ndarray:
    """Return points (N, 3) about 2 mm apart all over `surface`, in its own frame [m]."""
    points = surface.sample(0.5 * _SPACING_M).points
    _, first = np.unique(np.floor(points / _SPACING_M).astype(int), axis=0, return_index=True)
    return points[np.sort(first)]
