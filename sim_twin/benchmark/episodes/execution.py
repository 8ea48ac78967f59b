"""Execution of plans in the twin, with the outcome by the twin's ground truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Self

import numpy as np

from hal.base.errors import HalError
from hal.base.messages import RgbdFrame
from hal.rig import connect_rig
from sim_twin.backends import make_rig
from sim_twin.benchmark.episodes.contact_monitor import KNOCKED_M, KNOCKED_RAD, ContactMonitor
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from z1_runtime.config import RuntimeConfig
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.motion.executor import Executor, MotionError
from z1_runtime.motion.trajectory import MotionLimits, PathFailure, hold, straight_move
from z1_runtime.robot import Robot
from z1_runtime.types import GraspPlan, JointTrajectory

MIN_LIFT_M, MAX_SLIP_M, HOLD_S, CARRY_M = 0.05, 0.02, 1.0, 0.03
"""Success: at least 50 mm up for 1 s after a lift and a 30 mm sideways move, and under 20 mm of slip in the jaws."""
_MAX_TABLE_FORCE_N = 5.0


class Mode(StrEnum):
    """Outcome of an episode."""

    SUCCESS = "success"
    NO_DETECTION = "no detection"
    NO_CANDIDATE = "no candidate"
    NO_IK = "no IK"
    NO_PATH = "no path"
    TABLE_COLLISION = "table collision"
    KNOCKED = "object knocked"
    MISSED = "missed"
    SLIPPED = "slipped"
    DROPPED = "dropped"
    STOPPED = "arm stopped"
    """The servo braked: a limit, a stall, or a joint that did not follow."""
    ERROR = "error"
    """An exception, a defect of this software, ended the episode; its row keeps the exception's type and text."""


RETRIED = (Mode.MISSED, Mode.KNOCKED, Mode.SLIPPED, Mode.DROPPED)
"""Failures that are followed by another observation and attempt."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Result of one executed plan; NaN for stages that were not reached."""

    mode: Mode
    displacement_m: float = np.nan
    """Maximum displacement of the object before the jaws began to close [m]."""
    tilt_rad: float = np.nan
    """Maximum turn of the object before then [rad]."""
    table_force_n: float = np.nan
    """Maximum force between arm and table [N]."""
    jaws_touching: int = 0
    """Jaws on the object once closed."""
    jaw: float = np.nan
    """Jaw angle once closed [rad]."""
    jaw_torque_nm: float = np.nan
    """Gripper torque once closed [Nm]."""
    slip_m: float = np.nan
    """Displacement of the object in the jaws, from closed to the end [m]."""
    lifted_m: float = np.nan
    """Minimum height over its start during the last second [m]."""
    neighbours_knocked: int = 0
    """Neighbours that were moved by more than 15 mm or 15° since the episode began."""
    duration_s: float = np.nan
    """From the first motion to the end, on the robot's clock [s]."""
    detail: str = ""
    """Explanation, if any."""


class EpisodeRobot:
    """The lock-step `Robot` of an episode, at home in a scene of its own, with a ground-truth monitor.

    Use it in a `with` block. The camera is connected by the first `capture`, as a connected one holds a renderer.

    Args:
        scene: objects on the table.
        kinematics: shared by the episodes; None = loaded.
        speed: fraction of the arm's limits.
    """

    def __init__(self, scene: SceneConfig, kinematics: Kinematics | None = None, speed: float = 0.5) -> None:
        rig = make_rig(scene, lockstep=True)
        assert rig.call_every_tick is not None
        self.world: World = rig.world
        self._watch = ContactMonitor(rig.world)
        self._robot = Robot(connect_rig(rig, camera=False), config=RuntimeConfig(speed=speed), owner="bench")
        self._executor = Executor(self._robot.arm, self._robot.clock)
        self._kinematics, self._limits = kinematics or Kinematics(), MotionLimits.at_speed(speed)
        self._sees = False
        rig.call_every_tick(self._watch.tick)  # after the servo's own

    def __enter__(self) -> Self:
        self._robot.arm.claim("bench")
        return self

    def __exit__(self, *_: object) -> None:
        self._robot.close()

    def capture(self) -> tuple[RgbdFrame, np.ndarray]:
        """Return the camera's next frame and the joints (7,) it was taken at [rad], once the arm rests."""
        if not self._sees:
            self._robot.camera.connect()
            self._sees = True
        state = self._executor.settle()
        return self._robot.frame(), state.q

    def execute(self, plan: GraspPlan) -> Outcome:
        """Grasp, lift, carry sideways and hold; return the outcome."""
        carry_motion = plan_carry(self._kinematics, plan, self._limits)
        if carry_motion is None:
            return Outcome(mode=Mode.NO_PATH, detail="carry: the lifted object cannot be moved 30 mm in any direction.")
        self._watch.begin()
        start_s = self.world.time_s
        known: dict[str, Any] = {}
        try:
            self._grasp_and_lift(plan, carry_motion, known)
        except (MotionError, HalError) as error:
            outcome = Outcome(mode=Mode.STOPPED, detail=str(error), **known)
        else:
            outcome = Outcome(mode=Mode.SUCCESS, lifted_m=min(self._watch.lifted_m), **known)
        outcome = replace(
            outcome,
            table_force_n=self._watch.table_force_n,
            neighbours_knocked=self._watch.neighbours_knocked(),
            duration_s=self.world.time_s - start_s,
        )
        return outcome if outcome.mode is Mode.STOPPED else _classify(outcome)

    def withdraw(self, plan: GraspPlan, outcome: Outcome, jaw_home: float) -> None:
        """Go home with open jaws after a failed attempt at `plan`; an object still held is put down first.

        Raises:
            MotionError, HalError: the arm does not get there.
        """
        if outcome.mode is Mode.SLIPPED:
            # The way back is the way that was checked for collisions
            for motion in (plan.lift, plan.close, plan.approach):
                self._robot.move_to(motion.q[-1])
                self._executor.execute(_reversed(motion))
                self._executor.settle()
        self._robot.home(jaw=jaw_home, drop=True)

    def _grasp_and_lift(self, plan: GraspPlan, carry_motion: JointTrajectory, known: dict[str, Any]) -> None:
        """Execute all motions, and write each figure into `known` as soon as it is known."""
        watch, executor = self._watch, self._executor
        for motion in (plan.transfer, plan.approach):
            executor.execute(motion)
            executor.settle()
        known |= {"displacement_m": watch.displacement_m, "tilt_rad": watch.tilt_rad}
        executor.execute(plan.close)
        state = executor.settle()
        closed = watch.T_gripper_object()
        known |= {
            "jaws_touching": watch.jaws_touching(),
            "jaw": float(state.q[-1]),
            "jaw_torque_nm": float(state.tau[-1]),
        }
        for motion in (plan.lift, carry_motion):
            executor.execute(motion)
            executor.settle()
        # Success counts the heights of the last second alone
        watch.clear()
        executor.execute(hold(carry_motion.q[-1], HOLD_S))
        # In the frame of the stationary jaw the arm's own motion does not count as slip
        known["slip_m"] = float(np.linalg.norm(watch.T_gripper_object()[:3, 3] - closed[:3, 3]))


def capture(scene: SceneConfig) -> tuple[RgbdFrame, np.ndarray]:
    """Return the camera's frame from home and the joints (7,) it was taken at [rad]."""
    with EpisodeRobot(scene) as robot:
        return robot.capture()


def plan_carry(kinematics: Kinematics, plan: GraspPlan, limits: MotionLimits) -> JointTrajectory | None:
    """Return the 30 mm sideways move that follows the lift: towards the middle if possible, else another direction."""
    start = plan.lift.q[-1]
    T = kinematics.pivot(start[:6])
    # In the middle the sign is 0: either side will do
    inwards = -np.sign(T[1, 3]) or 1.0
    for direction in ((0.0, inwards), (0.0, -inwards), (-1.0, 0.0), (1.0, 0.0)):
        T_goal = T.copy()
        T_goal[:2, 3] += CARRY_M * np.array(direction)
        try:
            return straight_move(kinematics, T, T_goal, start, float(start[-1]), limits)
        except PathFailure:
            continue
    return None


def _reversed(motion: JointTrajectory) -> JointTrajectory:
    """Return the same motion from its end to its beginning."""
    return JointTrajectory(t_s=motion.t_s[-1] - motion.t_s[::-1], q=motion.q[::-1], dq=-motion.dq[::-1])


def _classify(outcome: Outcome) -> Outcome:
    """Return `outcome` with the mode that its figures give; of several causes the first in time."""
    if outcome.lifted_m >= MIN_LIFT_M and outcome.slip_m < MAX_SLIP_M:
        return outcome
    if outcome.table_force_n > _MAX_TABLE_FORCE_N:
        mode = Mode.TABLE_COLLISION
    elif outcome.displacement_m > KNOCKED_M or outcome.tilt_rad > KNOCKED_RAD:
        mode = Mode.KNOCKED
    elif outcome.jaws_touching < 2:
        mode = Mode.MISSED
    elif outcome.lifted_m >= MIN_LIFT_M:
        mode = Mode.SLIPPED
    else:
        mode = Mode.DROPPED
    return replace(outcome, mode=mode)
