"""Algorithm 1 of MVB-Grasp: from one frame to one plan.

`GraspSelector.select` is the whole algorithm; each of its lines is a stage with its own method, and nothing moves:

    1. observe      frame → Observation        detect the object, cut its cloud, fit the table
    2. generate     → GraspSet                 N grasps on the object's cloud
    3. filter       → RankedGrasps             fit the box, keep the grasps that approach one of its k nearest faces
    4. build_scene  → PlanningScene            everything the arm may hit, once for all stages after it
    5. rank         → RankedCandidates         fit the gripper, order by what arm and gripper can do
    6. plan         → GraspPlan                the first whose whole motion is feasible
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from hal.base import z1
from hal.base.clock import Stopwatch
from hal.base.messages import RgbdFrame
from models.obb.mvbb import RankedGrasps, fit_obb, rank_grasps
from models.types import GraspGenerator, GraspSet
from z1_runtime.collision.planning_scene import PlanningScene
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.config import RuntimeConfig, ranking_of
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.beak_gripper import BeakGripper
from z1_runtime.grasping.grasp_candidates import GraspCandidates
from z1_runtime.grasping.ranking import Ranking, fit_upright_box
from z1_runtime.perception.segmentation import Perception
from z1_runtime.planning.planner import GraspPlanner, NoPlanError
from z1_runtime.planning.reachability import RankedCandidates, ReachabilityRanker
from z1_runtime.types import GraspPlan, Observation

_LOG = logging.getLogger(__name__)


class StageTimes:
    """Real milliseconds of each stage, by name, in the order the stages ended."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the body's time to stage `name`."""
        watch = Stopwatch()
        try:
            yield
        finally:
            self.ms[name] = self.ms.get(name, 0.0) + watch.lap_ms()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraspSelection:
    """Results of all stages between one frame and the motion it leads to."""

    observation: Observation
    grasps: GraspSet
    """All that the generator proposed."""
    scene: PlanningScene
    ranked: RankedGrasps
    plan: GraspPlan
    success_probability: float | None
    """Of the planned grasp, by the fitted head of the ranking (`scoring` in the configuration); None without one."""
    stage_ms: dict[str, float]
    """By stage: detect, cloud, generate, mvbb, collision, rank, ik, plan, and their total."""


class GraspSelector:
    """Selects and plans one grasp per frame.

    Args:
        kinematics: of the arm.
        perception: makes clouds of a frame.
        generator: proposes grasps.
        planner: finds the first with a feasible motion.
        config: the numbers of the algorithm.
        T_flange_camera: (4, 4) hand-eye transform.

    Raises:
        ScoringError: the scoring file that `config` names cannot be used.
    """

    def __init__(
        self,
        *,
        kinematics: Kinematics,
        perception: Perception,
        generator: GraspGenerator,
        planner: GraspPlanner,
        config: RuntimeConfig,
        T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA,
    ) -> None:
        self.kinematics = kinematics
        self.perception = perception
        self.generator = generator
        self.planner = planner
        self.config = config
        self.ranking = ranking_of(config)
        self.gripper = BeakGripper(planner.config.gripper)
        self.T_flange_camera = T_flange_camera

    def select(self, frame: RgbdFrame, q: np.ndarray) -> GraspSelection:
        """Return the plan of the best feasible grasp in one frame, taken at joint positions `q` (7,).

        Raises:
            PerceptionError: no usable object was observed.
            DegenerateCloudError: the object's cloud spans no box.
            ValueError: the generator cannot use the cloud, such as an object wider than any opening.
            NoPlanError: no candidate can be executed; the message counts the reasons.
        """
        times = StageTimes()
        with times.stage("total"):
            observation = self.observe(frame, q, times)
            selection = self.select_from(observation, q, times)
        # Copied again: the total ends only here
        return replace(selection, stage_ms=dict(times.ms))

    def select_from(self, observation: Observation, q: np.ndarray, times: StageTimes | None = None) -> GraspSelection:
        """Return the plan of the best feasible grasp of `observation`; errors as `select`.

        Args:
            observation: one frame's clouds.
            q: (7,) joints it was taken at, from which the motion starts [rad].
            times: gets the stages.
        """
        times = times or StageTimes()
        with times.stage("generate"):
            grasps = self.generate(observation)
        with times.stage("mvbb"):
            filtered = self.filter(grasps, observation)
        with times.stage("collision"):
            scene = self.build_scene(observation, q)
        with times.stage("rank"):
            best_first = self.rank(filtered, scene)
        plan = self.planner.plan(best_first.candidates, q, times.stage)
        probability = best_first.success_probability
        return GraspSelection(
            observation=observation,
            grasps=grasps,
            scene=scene,
            ranked=best_first.ranked,
            plan=plan,
            success_probability=None if probability is None else float(probability[plan.rank]),
            stage_ms=dict(times.ms),
        )

    def observe(self, frame: RgbdFrame, q: np.ndarray, times: StageTimes | None = None) -> Observation:
        """Return the observation of `frame`, taken at joints `q` (7,); `times` gets the stages detect and cloud.

        Raises:
            PerceptionError: no usable object was observed.
        """
        times = times or StageTimes()
        with times.stage("detect"):
            filtered = self.perception.filter_self(frame, float(q[-1]))
            T_base_camera = self.kinematics.flange(q[: z1.N_ARM]) @ filtered.T_flange_camera
            detection = self.perception.detect(filtered, T_base_camera, self.config.object_class)
        with times.stage("cloud"):
            return self.perception.segment(filtered, T_base_camera, detection)

    def generate(self, observation: Observation) -> GraspSet:
        """Return the generator's candidates for the object, in the camera frame.

        Raises:
            ValueError: the generator cannot use the cloud.
        """
        return self.generator.sample(observation.object_points, self.config.n_candidates, self.config.seed)

    def filter(self, grasps: GraspSet, observation: Observation, ranking: Ranking | None = None) -> RankedGrasps:
        """Return the grasps that approach one of the nearest faces of the object's box, and that box.

        Args:
            grasps: camera frame.
            observation: the frame they were made from.
            ranking: method of the box, faces and weights; the configured one if None.

        Raises:
            DegenerateCloudError: the object's cloud spans no box.
            NoPlanError: no grasp does.
        """
        ranking = ranking or self.ranking
        up = observation.T_base_camera[2, :3]  # the base's z axis in the camera frame
        box = fit_obb(observation.object_points, ranking.box_method, up=up)
        # The paper: a_j > 0 on one of the k nearest faces, ordered by 0.85 · alignment + 0.15 · score
        ranked = rank_grasps(grasps, box, k=ranking.k_faces, alpha=ranking.alpha, hard_filter=ranking.hard_filter)
        if not len(ranked):
            raise NoPlanError(
                f"none of {len(grasps)} candidates approaches one of the {ranking.k_faces} nearest faces of the "
                "object's box. Raise k_faces or n_candidates, or observe from another side.",
                rejections=(),
                code="no_face",
            )
        return ranked

    def build_scene(self, observation: Observation, q: np.ndarray) -> PlanningScene:
        """Return the surroundings in `observation`, taken at joints `q` (7,), without the robot itself.

        Raises:
            ValueError: a point is not finite.
        """
        return PlanningScene.from_observation(observation, q, self.kinematics, self.planner.config.collision)

    def fit_candidates(
        self,
        grasps: GraspSet,
        scene: PlanningScene,
        *,
        ranked: RankedGrasps | None = None,
        ranking: Ranking | None = None,
        chunk: int | None = None,
    ) -> GraspCandidates:
        """Return `grasps` (camera frame) as candidates that are fitted to the gripper once, when first needed.

        Args:
            grasps: first to try first.
            scene: their surroundings.
            ranked: the ranking of these grasps, whose box is kept if `ranking` fitted it upright.
            ranking: its numbers; the upright box is fitted here if its head needs it and `ranked` has none.
            chunk: grasps that are fitted at once; None fits all of them.

        Raises:
            DegenerateCloudError: the object's cloud spans no box.
        """
        box = None
        if ranking is not None and ranking.box_method == "upright" and ranked is not None:
            box = ranked.box
        if box is None and ranking is not None and ranking.head is not None:
            # A head's features are measured on the upright box, whatever box the filter used
            box = fit_upright_box(scene.observation)
        return GraspCandidates.from_grasps(
            grasps,
            CollisionChecker(self.kinematics, scene),
            self.gripper,
            fallback_width_m=self.planner.config.fallback_width_m,
            upright_box=box,
            chunk=chunk,
        )

    def rank(self, filtered: RankedGrasps, scene: PlanningScene, ranking: Ranking | None = None) -> RankedCandidates:
        """Return the grasps that the box let pass, ordered by what arm and gripper can do.

        Args:
            filtered: with the box that chose them.
            scene: their surroundings.
            ranking: head and thresholds; the configured one if None.

        Raises:
            DegenerateCloudError: the object's cloud spans no upright box.
        """
        ranking = ranking or self.ranking
        candidates = self.fit_candidates(filtered.grasps, scene, ranked=filtered, ranking=ranking)
        ranker = ReachabilityRanker(self.kinematics, CollisionChecker(self.kinematics, scene), self.planner.config)
        return ranker.rank(filtered, candidates, ranking)
