"""Walks the ranked grasps and returns the first the arm can really do, with its whole motion and why others were not.

Cheap tests go first and in batches: width, then the gripper at the grasp against table, scene and object. What is left
gets inverse kinematics, the straight approach and lift, and the way to the pre-grasp, each checked for collisions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field

import numpy as np

from hal import z1
from models.types import GraspSet
from z1_runtime.collision import CollisionChecker, CollisionConfig, Problem, warm_up
from z1_runtime.gripper import BeakBatch, BeakConfig, BeakGripper
from z1_runtime.kinematics import Kinematics
from z1_runtime.trajectory import MotionLimits, PathFailure, gripper_move, joint_path, straight_move
from z1_runtime.types import GraspPlan, JointTrajectory, Observation, Rejection

StageTimer = Callable[[str], AbstractContextManager[None]]
"""`with timer("ik"): ...` adds the body's time to a stage."""

_CHUNK = 48
_MAX_SHAPE_POINTS = 1500
_PALM_HALF_WIDTH_M = 0.041


class NoPlanError(RuntimeError):
    """No candidate can be executed.

    Attributes:
        rejections: why each was refused, in rank order.
    """

    def __init__(self, message: str, rejections: tuple[Rejection, ...]) -> None:
        super().__init__(message)
        self.rejections = rejections


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannerConfig:
    """How a grasp is approached and lifted, and how long to search."""

    standoff_m: float = 0.09
    """From the pre-grasp to the grasp along the approach [m]."""
    short_standoff_m: float = 0.06
    """Tried where the arm cannot draw back that far [m]."""
    lift_m: float = 0.10
    """Straight up after closing [m]."""
    fallback_width_m: float = 0.06
    """Taken where neither the generator nor the cloud tells a width [m]."""
    max_tried: int = 60
    """Reachable candidates whose motion is planned before giving up; bounds the worst case."""
    max_branches: int = 2
    """Joint solutions tried per pre-grasp, nearest to home first."""
    raise_m: float = 0.12
    """How far above the pre-grasp the detour leads, when the direct way is blocked [m]."""
    beak: BeakConfig = field(default_factory=BeakConfig)
    """How the beak is laid around an object."""
    collision: CollisionConfig = field(default_factory=CollisionConfig)
    """How near is a collision."""

    def __post_init__(self) -> None:
        if not 0.0 < self.short_standoff_m <= self.standoff_m or self.lift_m <= 0.0 or self.max_tried < 1:
            raise ValueError(
                "PlannerConfig wants 0 < short_standoff_m <= standoff_m, lift_m > 0 and max_tried >= 1; got "
                f"{self.short_standoff_m}, {self.standoff_m}, {self.lift_m} and {self.max_tried}."
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Motion:
    transfer: JointTrajectory
    approach: JointTrajectory
    close: JointTrajectory
    lift: JointTrajectory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Way:
    """One candidate, one flip: all the motion needs to know."""

    T_base_pivot: np.ndarray
    """(4, 4) at the grasp."""
    T_base_grasp: np.ndarray
    """(4, 4)."""
    jaw_open: float
    """[rad]"""


class _Refused(Exception):
    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason


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
        with timer("collision"):
            checker = CollisionChecker(self._kinematics, observation, q_start, self.config.collision)
            fitted = _Fitted(self, ranked, observation.T_base_camera, checker)
        rejections: list[Rejection] = []
        tried = 0
        for rank in range(len(ranked)):
            with timer("collision"):
                ways = fitted.ways(rank)
            if isinstance(ways, Problem):
                rejections.append(Rejection(rank=rank, reason=ways.reason, detail=ways.detail))
                continue
            if tried == self.config.max_tried:
                break
            try:
                way, motion = self._first_motion(ways, checker, q_start, timer)
            except _Refused as refusal:
                rejections.append(Rejection(rank=rank, reason=refusal.reason, detail=str(refusal)))
                tried += refusal.reason != "ik"  # those cost a fraction of a millisecond
                continue
            return GraspPlan(
                rank=rank,
                T_base_grasp=way.T_base_grasp,
                width_m=float(fitted.widths_m[rank]),
                T_base_pivot=way.T_base_pivot,
                jaw_open=way.jaw_open,
                jaw_contact=float(fitted.jaw_contact(rank)),
                transfer=motion.transfer,
                approach=motion.approach,
                close=motion.close,
                lift=motion.lift,
                rejections=tuple(rejections),
            )
        raise NoPlanError(_explain(len(ranked), rejections), tuple(rejections))

    def _first_motion(
        self, ways: list[_Way], checker: CollisionChecker, q_start: np.ndarray, timer: StageTimer
    ) -> tuple[_Way, _Motion]:
        """Return the first flip and branch whose motion passes, or raise the refusal that came furthest."""
        furthest: tuple[int, _Refused] | None = None
        for way in ways:
            for standoff_m in dict.fromkeys((self.config.standoff_m, self.config.short_standoff_m)):
                T_pre = _shifted(way.T_base_pivot, -standoff_m * way.T_base_grasp[:3, 2])
                with timer("ik"):
                    branches, refusal = self._branches(T_pre, way)
                if refusal is not None:
                    furthest = furthest or (0, refusal)
                for q_arm in branches:
                    try:
                        with timer("plan"):
                            return way, self._motion(way, T_pre, q_arm, checker, q_start)
                    except _Refused as refusal:
                        stage = ("ik", "path", "table", "self", "object", "scene").index(refusal.reason)
                        if furthest is None or stage > furthest[0]:
                            furthest = stage, refusal
                if branches:
                    break
        assert furthest is not None
        raise furthest[1]

    def _branches(self, T_pre: np.ndarray, way: _Way) -> tuple[list[np.ndarray], _Refused | None]:
        """Return pre-grasp joints (6,), nearest to home first, or which of the three poses is out of reach."""
        T_lifted = _shifted(way.T_base_pivot, np.array([0.0, 0.0, self.config.lift_m]))
        branches: list[np.ndarray] = []
        for name, T in (("grasp", way.T_base_pivot), ("lifted pose", T_lifted), ("pre-grasp", T_pre)):
            branches = self._kinematics.solve(T)
            if not branches:
                x, y, z = T[:3, 3]
                return [], _Refused("ik", f"no joints reach the {name}, the pivot at ({x:.3f}, {y:.3f}, {z:.3f}) m.")
        branches.sort(key=lambda q: float(np.sum((q - z1.Q_HOME) ** 2)))
        return branches[: self.config.max_branches], None

    def _motion(
        self, way: _Way, T_pre: np.ndarray, q_arm: np.ndarray, checker: CollisionChecker, q_start: np.ndarray
    ) -> _Motion:
        config, limits = checker.config, self._limits
        q_pre = np.append(q_arm, way.jaw_open)
        T_lifted = _shifted(way.T_base_pivot, np.array([0.0, 0.0, self.config.lift_m]))
        try:
            approach = straight_move(self._kinematics, T_pre, way.T_base_pivot, q_pre, way.jaw_open, limits)
            # The servo bounds the torque, so "closed" is where the jaws are sent, not where they end.
            close = gripper_move(approach.q[-1], z1.GRIPPER_CLOSED, limits)
            lift = straight_move(self._kinematics, way.T_base_pivot, T_lifted, close.q[-1], z1.GRIPPER_CLOSED, limits)
        except PathFailure as failure:
            raise _Refused("path", str(failure)) from failure
        _refuse(
            checker.check_trajectory(
                approach, threshold_m=config.scene_threshold_m, object_threshold_m=config.object_threshold_m
            ),
            "on the approach, ",
        )
        _refuse(checker.check_trajectory(lift, threshold_m=config.scene_threshold_m), "while lifting, ")
        transfer = self._transfer(q_start, q_pre, T_pre, checker)
        return _Motion(transfer=transfer, approach=approach, close=close, lift=lift)

    def _transfer(
        self, q_start: np.ndarray, q_pre: np.ndarray, T_pre: np.ndarray, checker: CollisionChecker
    ) -> JointTrajectory:
        """Return the first free way to the pre-grasp: direct, over a raised pose, or by way of home."""
        near_m = checker.config.transfer_threshold_m
        first: Problem | None = None
        for via in self._detours(q_pre, T_pre):
            transfer = joint_path(np.array([q_start, *via, q_pre]), self._limits)
            problem = checker.check_trajectory(transfer, threshold_m=near_m, object_threshold_m=near_m)
            if problem is None:
                return transfer
            first = first or problem
        assert first is not None
        raise _Refused("path", f"every way to the pre-grasp is blocked; directly, {first.detail}")

    def _detours(self, q_pre: np.ndarray, T_pre: np.ndarray) -> Iterator[list[np.ndarray]]:
        yield []
        raised = self._kinematics.solve(_shifted(T_pre, np.array([0.0, 0.0, self.config.raise_m])))
        if raised:
            nearest = min(raised, key=lambda q: float(np.abs(q - q_pre[: z1.N_ARM]).max()))
            yield [np.append(nearest, q_pre[-1])]
        yield [np.append(z1.Q_HOME, q_pre[-1])]


class _Fitted:
    """All candidates in the base frame, fitted and pre-checked chunk by chunk, so that an early hit comes fast."""

    def __init__(self, planner: GraspPlanner, ranked: GraspSet, T_base_camera: np.ndarray, checker: CollisionChecker):
        self._config = planner.config
        self._gripper = planner.gripper
        self._checker = checker
        self._T_base_grasps = T_base_camera @ ranked.T_camera_grasps
        points = checker.object_points
        self._shape_points = points[:: max(1, len(points) // _MAX_SHAPE_POINTS)]
        self.widths_m = np.array(ranked.widths_m, dtype=np.float64)
        self._fronts_m = np.full(len(ranked), np.nan)
        self._chunks: dict[int, tuple[BeakBatch, list[list[Problem | None]]]] = {}

    def jaw_contact(self, rank: int) -> float:
        """Return the mover angle at which candidate `rank` is touched [rad]."""
        return float(self._chunks[rank // _CHUNK][0].jaw_contact[rank % _CHUNK])

    def ways(self, rank: int) -> list[_Way] | Problem:
        """Return the flips of candidate `rank` that hit nothing at the grasp, or why there is none."""
        if rank // _CHUNK not in self._chunks:
            self._fit_chunk(rank // _CHUNK)
        batch, problems = self._chunks[rank // _CHUNK]
        n = rank % _CHUNK
        under = [problem for problem in problems[n] if problem is not None and problem.reason == "table"]
        if len(under) == len(problems[n]):
            return under[0]
        if not batch.fits[n]:
            return Problem(
                reason="width", detail=self._gripper.refusal(float(self.widths_m[rank]), float(self._fronts_m[rank]))
            )
        T_base_grasp = self._T_base_grasps[rank]
        # The pivot's +y carries the camera: above the hand it is clear of the table and sees the object
        camera_up_first = (0, 1) if T_base_grasp[2, 0] >= 0.0 else (1, 0)
        free = [flip for flip in camera_up_first if problems[n][flip] is None]
        if not free:
            problem = problems[n][camera_up_first[0]]
            assert problem is not None
            return problem
        return [
            _Way(
                T_base_pivot=batch.T_base_pivots[n, flip],
                T_base_grasp=T_base_grasp,
                jaw_open=float(batch.jaw_open[n]),
            )
            for flip in free
        ]

    def _fit_chunk(self, chunk: int) -> None:
        part = slice(chunk * _CHUNK, (chunk + 1) * _CHUNK)
        T_base_grasps = self._T_base_grasps[part]
        self._measure(part)
        batch = self._gripper.fit_batch(T_base_grasps, self.widths_m[part], self._fronts_m[part])
        pivots, jaws = batch.T_base_pivots.reshape(-1, 4, 4), np.repeat(batch.jaw_open, 2)
        hits = self._checker.check_grippers(pivots, jaws)
        problems = [[hits.problem(2 * n + flip) for flip in range(2)] for n in range(len(T_base_grasps))]
        self._chunks[chunk] = batch, problems

    def _measure(self, part: slice) -> None:
        """Fill in widths nobody gave, and how far the object reaches towards the palm, from the object's points."""
        depth_m = self._config.beak.contact_depth_m
        for rank in range(*part.indices(len(self.widths_m))):
            T = self._T_base_grasps[rank]
            x, y, z = ((self._shape_points - T[:3, 3]) @ T[:3, :3]).T
            between = np.abs(x) < _PALM_HALF_WIDTH_M
            if not np.isfinite(self.widths_m[rank]):
                beside_pads = between & (np.abs(z + depth_m) < 0.025) & (np.abs(y) < 0.06)
                seen_m = float(2.0 * np.abs(y[beside_pads]).max()) if beside_pads.any() else np.nan
                self.widths_m[rank] = seen_m if np.isfinite(seen_m) else self._config.fallback_width_m
            between &= np.abs(y) < 0.5 * self.widths_m[rank] + 0.005
            # A percentile, not the nearest point: one speckle would push the whole hand back
            front_m = -np.percentile(z[between], 1.0) - depth_m if between.any() else 0.0
            self._fronts_m[rank] = max(front_m, 0.0)


def _refuse(problem: Problem | None, when: str) -> None:
    if problem is not None:
        raise _Refused(problem.reason, when + problem.detail)


def _shifted(T: np.ndarray, by: np.ndarray) -> np.ndarray:
    T = T.copy()
    T[:3, 3] += by
    return T


def _explain(n: int, rejections: list[Rejection]) -> str:
    counts = Counter(rejection.reason for rejection in rejections).most_common()
    parts = [f"{count} {reason}" for reason, count in counts]
    if len(rejections) < n:
        parts.append(f"{n - len(rejections)} not tried, the search budget (max_tried) was spent")
    last = f" The best-ranked one: {rejections[0].detail}" if rejections else ""
    return f"none of {n} candidates can be executed: {', '.join(parts) or 'there were none'}.{last}"
