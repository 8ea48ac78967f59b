"""One pick, Algorithm 1 of MVB-Grasp: see, propose, filter by the box, plan, move; each stage timed and counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from hal import z1
from hal.arm import ServoedArm
from hal.camera import Camera
from hal.clock import Clock, Stopwatch
from hal.messages import ArmState, RgbdFrame
from models.mvbb import RankedGrasps, fit_obb, rank_grasps
from models.types import GraspGenerator, GraspSet
from z1_runtime.config import RuntimeConfig
from z1_runtime.executor import Executor
from z1_runtime.inspect import Inspector
from z1_runtime.kinematics import Kinematics
from z1_runtime.perception import Perception
from z1_runtime.planner import GraspPlanner
from z1_runtime.trajectory import hold, joint_move
from z1_runtime.types import GraspPlan, Observation


class StageTimes:
    """Real milliseconds a stage took, by name, in the order the stages ran."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Phase:
    """A named part of the pick, on the robot's clock."""

    name: str
    start_s: float
    duration_s: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decision:
    """Everything between one frame and the motion it leads to."""

    observation: Observation
    candidates: GraspSet
    ranked: RankedGrasps
    plan: GraspPlan
    stage_ms: dict[str, float]
    """By stage: detect, cloud, generate, mvbb, ik, collision, plan, and their total."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PickRecord:
    """What happened, for reports."""

    decision: Decision
    phases: tuple[Phase, ...]
    held: bool
    """The jaws still hold something after the lift, by the gripper's own angle and torque."""
    jaw: float
    """Mover angle after the lift [rad]; 0 is closed on nothing."""
    jaw_torque_nm: float
    """Gripper torque after the lift [Nm]."""
    rejections: dict[str, int] = field(default_factory=dict)
    """Refused candidates before the executed one, by reason."""


@dataclass(slots=True)
class PickPipeline:
    """Wires the stages together; each can be called alone."""

    arm: ServoedArm
    camera: Camera
    clock: Clock
    kinematics: Kinematics
    perception: Perception
    generator: GraspGenerator
    planner: GraspPlanner
    executor: Executor
    inspector: Inspector
    config: RuntimeConfig
    T_flange_camera: np.ndarray = field(default_factory=lambda: z1.T_FLANGE_CAMERA)
    """(4, 4) hand-eye transform."""
    phases: list[Phase] = field(default_factory=list)

    def decide(self, frame: RgbdFrame, q: np.ndarray) -> Decision:
        """Turn one frame, taken at joint positions `q` (7,), into a plan; nothing moves.

        Raises:
            PerceptionError: nothing usable was seen.
            DegenerateCloudError: the object's cloud spans no box.
            NoPlanError: no candidate can be executed; the message counts why.
        """
        config = self.config
        times = StageTimes()
        with times.stage("total"):
            T_base_camera = self.kinematics.flange(q[: z1.N_ARM]) @ self.T_flange_camera
            with times.stage("detect"):
                detection = self.perception.detect(frame, T_base_camera)
            with times.stage("cloud"):
                observation = self.perception.segment(frame, T_base_camera, detection)
            with times.stage("generate"):
                candidates = self.generator.sample(observation.object_points, config.n_candidates, config.seed)
            with times.stage("mvbb"):
                up = T_base_camera[2, :3]  # base z, seen from the camera
                box = fit_obb(observation.object_points, config.box_method, up=up)
                ranked = rank_grasps(candidates, box, k=config.k_faces, alpha=config.alpha)
            plan = self.planner.plan(ranked.grasps, observation, q, times.stage)
        return Decision(
            observation=observation, candidates=candidates, ranked=ranked, plan=plan, stage_ms=dict(times.ms)
        )

    def pick(self) -> PickRecord:
        """Look, decide, and execute the grasp; the lease must be held.

        Raises:
            As `decide`, and `MotionError` or `CommandRefusedError` when the arm does not follow.
        """
        self.phases.clear()
        with self._phase("home"):
            self._go_home()
        with self._phase("look"):
            state = self.executor.settle()
            frame = self.camera.wait_for_frame(self.config.frame_timeout_s)
        with self._phase("decide"):
            decision = self.decide(frame, state.q)
            self._inspect(decision)
        state = self._execute(decision.plan)
        jaw, torque = float(state.q[-1]), float(state.tau[-1])
        return PickRecord(
            decision=decision,
            phases=tuple(self.phases),
            held=jaw < self.config.jaw_empty and abs(torque) > self.config.held_torque_nm,
            jaw=jaw,
            jaw_torque_nm=torque,
            rejections=dict(Counter(rejection.reason for rejection in decision.plan.rejections)),
        )

    def _go_home(self) -> None:
        q = np.clip(self.arm.status().q_command, z1.Q_MIN, z1.Q_MAX)
        q_home = np.append(z1.Q_HOME, self.config.jaw_home)
        if np.abs(q - q_home).max() > 1e-3:
            self.executor.execute(joint_move(q, q_home, self.config.motion))

    def _execute(self, plan: GraspPlan) -> ArmState:
        with self._phase("transfer"):
            self.executor.execute(plan.transfer)
            self.executor.settle()
        with self._phase("approach"):
            self.executor.execute(plan.approach)
            self.executor.settle()
        with self._phase("close"):
            self.executor.execute(plan.close)
            self.executor.settle()
        with self._phase("lift"):
            self.executor.execute(plan.lift)
            self.executor.settle()
        with self._phase("hold"):
            self.executor.execute(hold(plan.lift.q[-1], self.config.hold_s))
            return self.arm.read_state()

    def _inspect(self, decision: Decision) -> None:
        observation, ranked = decision.observation, decision.ranked
        self.inspector.log_frame(observation.frame, observation.T_base_camera)
        self.inspector.log_observation(observation)
        self.inspector.log_box(ranked.box, ranked.faces, observation.T_base_camera)
        self.inspector.log_candidates(ranked.grasps, observation.T_base_camera)
        self.inspector.log_plan(decision.plan)
        self.inspector.log_stage_times(decision.stage_ms)

    @contextmanager
    def _phase(self, name: str) -> Iterator[None]:
        start_s = self.clock.now_s()
        self.inspector.log_phase(name, start_s)
        try:
            yield
        finally:
            self.phases.append(Phase(name=name, start_s=start_s, duration_s=self.clock.now_s() - start_s))
