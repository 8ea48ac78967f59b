"""From one frame to one plan: Algorithm 1 of MVB-Grasp up to the motion; each stage timed, nothing moves."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import numpy as np

from hal.base import z1
from hal.base.clock import Stopwatch
from hal.base.messages import Intrinsics, RgbdFrame
from models.obb.mvbb import RankedGrasps, fit_obb, rank_grasps
from models.types import GraspGenerator, GraspSet
from z1_runtime.config import RuntimeConfig, ranking_of
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.ranking import Ranking
from z1_runtime.perception import extrinsics_check
from z1_runtime.perception.detectors import GroundTruthDetector
from z1_runtime.perception.segmentation import Perception, PerceptionError
from z1_runtime.planning.planner import GraspPlanner, NoPlanError
from z1_runtime.types import GraspPlan, Observation

_LOG = logging.getLogger(__name__)


class StageTimes:
    """Real milliseconds each stage took, by name, in the order the stages ended."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time the body takes to stage `name`."""
        watch = Stopwatch()
        try:
            yield
        finally:
            self.ms[name] = self.ms.get(name, 0.0) + watch.lap_ms()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraspSelection:
    """Everything between one frame and the motion it leads to."""

    observation: Observation
    candidates: GraspSet
    ranked: RankedGrasps
    plan: GraspPlan
    stage_ms: dict[str, float]
    """By stage: detect, cloud, generate, mvbb, rank, ik, collision, plan, and their total."""


class GraspSelector:
    """Sees, proposes, filters by the box, and plans.

    Args:
        kinematics: of the arm.
        perception: makes clouds of a frame.
        generator: proposes grasps.
        planner: finds the first that the arm can do.
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
        self.T_flange_camera = T_flange_camera
        self._mount_doubted = False

    def decide(self, frame: RgbdFrame, q: np.ndarray) -> GraspSelection:
        """Turn one frame, taken at joint positions `q` (7,), into a plan.

        Raises:
            PerceptionError: nothing usable was seen.
            DegenerateCloudError: the object's cloud spans no box.
            ValueError: the generator can make nothing of the cloud, such as an object wider than any opening.
            NoPlanError: no candidate can be executed; the message counts why.
        """
        times = StageTimes()
        with times.stage("total"):
            observation = self.observe(frame, q, times)
            candidates, ranked, plan = self._choose(observation, q, times)
        return GraspSelection(
            observation=observation, candidates=candidates, ranked=ranked, plan=plan, stage_ms=dict(times.ms)
        )

    def _choose(
        self, observation: Observation, q: np.ndarray, times: StageTimes
    ) -> tuple[GraspSet, RankedGrasps, GraspPlan]:
        with times.stage("generate"):
            candidates = self.propose(observation)
        with times.stage("mvbb"):
            ranked = self._chosen_by_box(candidates, observation, self.ranking)
        with times.stage("rank"):
            ranked = self._by_ability(ranked, observation, self.ranking)
        return candidates, ranked, self.planner.plan(ranked.grasps, observation, q, times.stage)

    def observe(self, frame: RgbdFrame, q: np.ndarray, times: StageTimes | None = None) -> Observation:
        """Return what `frame`, taken at joint positions `q` (7,), shows; `times` gets the stages detect and cloud.

        Raises:
            PerceptionError: nothing usable was seen.
        """
        times = times or StageTimes()
        jaw = float(q[-1])
        with times.stage("detect"):
            T_base_camera = self.kinematics.flange(q[: z1.N_ARM]) @ self._mount_in(frame, jaw)
            detection = self.perception.detect(frame, T_base_camera, jaw, self.config.object_class or None)
        with times.stage("cloud"):
            return self.perception.segment(frame, T_base_camera, jaw, detection)

    def _mount_in(self, frame: RgbdFrame, jaw: float) -> np.ndarray:
        """Return T_flange_camera (4, 4) as it is known, or as the jaws in `frame` show it where that is another."""
        seen = self.config.perception.mount.correct(frame, jaw, self.T_flange_camera)
        if seen is None:
            return self.T_flange_camera
        if not self._mount_doubted:
            self._mount_doubted = True
            _LOG.warning(
                "the jaws in the picture show the camera off its mount: what is 0.4 m ahead is %.1f mm beside its "
                "place. Each look makes up for it; calibrate the camera with `./z1 calibrate hand-eye`.",
                1e3 * seen.moved_m,
            )
        return seen.T_flange_camera

    def propose(self, observation: Observation) -> GraspSet:
        """Return the generator's candidates for the object, in the camera frame.

        Raises:
            ValueError: the generator can make nothing of the cloud.
        """
        return self.generator.sample(observation.object_points, self.config.n_candidates, self.config.seed)

    def rank(self, candidates: GraspSet, observation: Observation, ranking: Ranking | None = None) -> RankedGrasps:
        """Return the candidates that come at one of the nearest faces of the object's box, best first.

        The box chooses, as in the paper; among those it lets pass the order is by what arm and gripper can do.

        Args:
            candidates: camera frame.
            observation: the frame they were made from.
            ranking: the numbers to do it by; None are the configuration's.

        Raises:
            DegenerateCloudError: the object's cloud spans no box.
            NoPlanError: none does.
        """
        ranking = ranking or self.ranking
        return self._by_ability(self._chosen_by_box(candidates, observation, ranking), observation, ranking)

    def _chosen_by_box(self, candidates: GraspSet, observation: Observation, ranking: Ranking) -> RankedGrasps:
        up = observation.T_base_camera[2, :3]  # the base's z axis, seen from the camera
        box = fit_obb(observation.object_points, ranking.box_method, up=up)
        ranked = rank_grasps(candidates, box, k=ranking.k_faces, alpha=ranking.alpha, hard_filter=ranking.hard_filter)
        if not len(ranked):
            raise NoPlanError(
                f"none of {len(candidates)} candidates comes at one of the {ranking.k_faces} nearest faces of the "
                "object's box; raise k_faces or n_candidates, or look from another side.",
                rejections=(),
            )
        return ranked

    def _by_ability(self, ranked: RankedGrasps, observation: Observation, ranking: Ranking) -> RankedGrasps:
        assert ranked.box is not None
        middle = ranked.box.T_camera_box[:3, 3]
        return ranked.reordered(self.planner.ability(ranked.grasps, observation, middle, ranked.alignments, ranking))

    def warm_up(self) -> None:
        """Decide once on a drawn scene, so that the first real frame does not wait for compilers and caches."""
        if self.config.perception.mount.enabled:
            extrinsics_check.warm_up()  # no jaws are in the drawn scene
        q = np.append(z1.Q_HOME, self.config.jaw_home)
        T_base_camera = self.kinematics.flange(z1.Q_HOME) @ self.T_flange_camera
        frame = draw_can(T_base_camera)
        (can,) = GroundTruthDetector().detect(frame, T_base_camera)
        with suppress(PerceptionError):  # who looks at colours sees no can in a black picture, but is warm then
            self.perception.detect(frame, T_base_camera, self.config.jaw_home)
        try:
            observation = self.perception.segment(frame, T_base_camera, self.config.jaw_home, can)
            self._choose(observation, q, StageTimes())
        except (PerceptionError, NoPlanError) as error:  # what cannot be done there may be possible here
            _LOG.info("the warm-up scene has no plan under this configuration: %s", error)


def draw_can(T_base_camera: np.ndarray, radius_m: float = 0.03, height_m: float = 0.15) -> RgbdFrame:
    """Return an exact frame, from `T_base_camera` (4, 4), of an upright can 0.48 m in front of the base."""
    intrinsics = Intrinsics(width=640, height=480, fx=393.0, fy=393.0, cx=319.5, cy=239.5)
    d = intrinsics.rays() @ T_base_camera[:3, :3].T  # per metre of depth, in the base frame
    eye = T_base_camera[:3, 3] - [0.48, 0.0, 0.0]

    with np.errstate(divide="ignore", invalid="ignore"):
        table = np.where(d[..., 2] < 0, -eye[2] / d[..., 2], np.inf)
        a = d[..., 0] ** 2 + d[..., 1] ** 2
        b = d[..., 0] * eye[0] + d[..., 1] * eye[1]
        side = (-b - np.sqrt(b**2 - a * (eye[0] ** 2 + eye[1] ** 2 - radius_m**2))) / a
        side_z = eye[2] + side * d[..., 2]
        side = np.where((side_z > 0) & (side_z < height_m), side, np.inf)
        lid = np.where(d[..., 2] < 0, (height_m - eye[2]) / d[..., 2], np.inf)
        lid_off = (eye[0] + lid * d[..., 0]) ** 2 + (eye[1] + lid * d[..., 1]) ** 2
        lid = np.where(lid_off < radius_m**2, lid, np.inf)
    depth = np.minimum(table, np.fmin(side, lid))
    depth[~(depth < 1.5)] = 0.0
    return RgbdFrame(
        colour=np.zeros((*depth.shape, 3), np.uint8),
        depth_m=depth,
        intrinsics=intrinsics,
        stamp_s=0.0,
        sequence=0,
        ground_truth_mask=np.fmin(side, lid) < table,
    )
