"""One pick: capture a frame from home, select a grasp, approach, close, lift, hold."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hal.base import z1
from hal.base.clock import Clock
from hal.base.messages import ArmState
from models.obb.obb import DegenerateCloudError
from z1_runtime.config import RuntimeConfig
from z1_runtime.motion.executor import Executor
from z1_runtime.motion.trajectory import MotionLimits, hold, joint_move
from z1_runtime.perception.detector import PerceptionError
from z1_runtime.planning.planner import NoPlanError
from z1_runtime.tasks.grasp_selection import GraspSelection, GraspSelector
from z1_runtime.tasks.holding import check_empty, is_holding
from z1_runtime.types import GraspPlan
from z1_runtime.visualization.rerun_logger import RerunLogger

if TYPE_CHECKING:
    from hal.base.arm import ServoedArm
    from hal.base.camera import Camera

_LOG = logging.getLogger(__name__)

_AT_HOME_RAD = 1e-3  # an arm this near to home need not move; it is taken where it is


@dataclass(frozen=True, slots=True, kw_only=True)
class Phase:
    """A named part of a pick, on the robot's clock."""

    name: str
    start_s: float
    duration_s: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PickResult:
    """Outcome of one executed pick."""

    held: bool
    """The jaws still hold something after the lift, by the gripper's own angle and torque."""
    selection: GraspSelection
    phases: tuple[Phase, ...]
    jaw: float
    """Jaw angle after the lift [rad]; 0 is closed on nothing."""
    jaw_torque_nm: float
    """Gripper torque after the lift [Nm]."""

    @property
    def grasp(self) -> GraspPlan:
        """The executed grasp with its motion."""
        return self.selection.plan

    @property
    def success_probability(self) -> float | None:
        """Probability of success of that grasp before it was tried; None without a fitted ranking."""
        return self.selection.success_probability

    @property
    def rejections(self) -> dict[str, int]:
        """Number of candidates that were tried and not taken, by reason."""
        return dict(Counter(rejection.reason.value for rejection in self.selection.plan.rejections))

    @property
    def stage_ms(self) -> dict[str, float]:
        """Real time of each stage of the selection [ms]."""
        return self.selection.stage_ms


class PickTask:
    """Picks with connected devices whose lease is held.

    Args:
        selector: selects and plans a grasp in a frame.
        arm: the servoed arm.
        camera: the wrist camera.
        clock: of both devices.
        logger: log of all stages.
        config: speeds, times and thresholds of a pick.
        on_phase: called with each phase that ended well.
    """

    def __init__(
        self,
        *,
        selector: GraspSelector,
        arm: ServoedArm,
        camera: Camera,
        clock: Clock,
        logger: RerunLogger,
        config: RuntimeConfig,
        on_phase: Callable[[Phase], None] = lambda _: None,
    ) -> None:
        self.selector = selector
        self.arm = arm
        self.camera = camera
        self.clock = clock
        self.logger = logger
        self.config = config
        self.on_phase = on_phase
        self.executor = Executor(arm, clock, config.executor)
        self.executor.watchers.append(logger.log_arm)
        self._motion = MotionLimits.at_speed(config.speed)
        self._phases: list[Phase] = []

    def pick(self, *, drop: bool = False) -> PickResult:
        """Capture a frame, select a grasp, and execute it.

        Args:
            drop: open the jaws also when they hold an object.

        Raises:
            GripperLoadedError: the jaws hold an object and `drop` is False; nothing moves.
            As `GraspSelector.select`; and `MotionError`, `HalError` when the arm does not follow.
        """
        if not drop:
            check_empty(self.arm.read_state(), self.config, "pick")
        self._phases.clear()
        with self._phase("home"):
            self._go_home()
        with self._phase("look"):
            # At rest first: a moving arm would pair the frame with the joints of another moment
            state = self.executor.settle()
            frame = self.camera.wait_for_frame(self.config.frame_timeout_s)
        with self._phase("decide"):
            selection = self.selector.select(frame, state.q)
        self._log(selection)
        state = self._execute(selection.plan)
        jaw, torque = float(state.q[-1]), float(state.tau[-1])
        return PickResult(
            held=is_holding(state, self.config),
            selection=selection,
            phases=tuple(self._phases),
            jaw=jaw,
            jaw_torque_nm=torque,
        )

    def pick_until_held(self, *, drop: bool = False) -> PickResult:
        """Pick, and while the jaws hold nothing pick again from the scene as it then is, `attempts` times in all.

        Returns the last pick that was executed: an object pushed out of view or out of reach ends the attempts too.

        Args:
            drop: open the jaws also when they hold an object at the start.

        Raises:
            As `pick`, for the first attempt; for later ones only errors of the arm or the HAL.
        """
        result = self.pick(drop=drop)
        for attempt in range(2, self.config.attempts + 1):
            if result.held:
                break
            _LOG.info("the jaws closed on nothing; attempt %d of %d", attempt, self.config.attempts)
            try:
                result = self.pick()
            except (PerceptionError, DegenerateCloudError, NoPlanError) as error:
                _LOG.warning("no further attempt: %s", error)
                break
        return result

    def _go_home(self) -> None:
        # A command that the servo took from a measured state may be a hair beyond a limit
        q = np.clip(self.arm.status().q_command, z1.Q_MIN, z1.Q_MAX)
        q_home = np.append(z1.Q_HOME, self.config.jaw_home)
        if np.abs(q - q_home).max() > _AT_HOME_RAD:
            self.executor.execute(joint_move(q, q_home, self._motion))

    def _execute(self, plan: GraspPlan) -> ArmState:
        motions = {"transfer": plan.transfer, "approach": plan.approach, "close": plan.close, "lift": plan.lift}
        for name, motion in motions.items():
            with self._phase(name):
                self.executor.execute(motion)
                # Each phase is planned from rest at the end of the one before
                self.executor.settle()
        with self._phase("hold"):
            self.executor.execute(hold(plan.lift.q[-1], self.config.hold_s))
        return self.arm.read_state()

    def _log(self, selection: GraspSelection) -> None:
        observation, ranked = selection.observation, selection.ranked
        self.logger.log_observation(observation)
        self.logger.log_planning_scene(selection.scene)
        self.logger.log_box(ranked.box, ranked.faces, observation.T_base_camera)
        self.logger.log_candidates(ranked.grasps, observation.T_base_camera)
        self.logger.log_plan(selection.plan)
        self.logger.log_stage_times(selection.stage_ms)

    @contextmanager
    def _phase(self, name: str) -> Iterator[None]:
        start_s = self.clock.now_s()
        self.logger.log_phase(name, start_s)
        try:
            yield
        except Exception:
            self.logger.log_phase(f"{name} failed", self.clock.now_s())
            raise
        phase = Phase(name=name, start_s=start_s, duration_s=self.clock.now_s() - start_s)
        self._phases.append(phase)
        self.on_phase(phase)
