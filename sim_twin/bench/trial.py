"""Executes a plan in the twin and says, by the twin's own truth, how it ended."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from hal.errors import HalError
from hal.guard import Guard
from hal.messages import RgbdFrame
from hal.servo import Servo
from sim_twin.backends import make_rig
from sim_twin.bench.watch import Watch
from sim_twin.scene import SceneConfig
from sim_twin.world import World
from z1_runtime.executor import Executor, MotionError
from z1_runtime.kinematics import Kinematics
from z1_runtime.trajectory import MotionLimits, PathFailure, hold, straight_move
from z1_runtime.types import GraspPlan, JointTrajectory

UP_M, SLIP_M, HOLD_S, ASIDE_M = 0.05, 0.02, 1.0, 0.03
"""Success: at least 50 mm up for 1 s after a lift and a 30 mm move aside, and less than 20 mm of slip in the hand."""
_KNOCKED_M, _KNOCKED_RAD = 0.015, np.radians(15.0)
_TABLE_N = 5.0


class Mode(StrEnum):
    """How an episode ended."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What became of one executed plan; NaN where it did not come that far."""

    mode: Mode
    displacement_m: float = np.nan
    """Most that the object moved before the jaws began to close [m]."""
    tilt_rad: float = np.nan
    """Most that it turned before then [rad]."""
    table_force_n: float = np.nan
    """Most force between arm and table [N]."""
    jaws_touching: int = 0
    """Jaws on the object once closed."""
    jaw: float = np.nan
    """Mover angle once closed [rad]."""
    jaw_torque_nm: float = np.nan
    """Gripper torque once closed [Nm]."""
    slip_m: float = np.nan
    """How far the object moved in the hand, from closed to the end [m]."""
    lifted_m: float = np.nan
    """Least height over its start during the last second [m]."""
    duration_s: float = np.nan
    """From the first motion to the end, on the robot's clock [s]."""
    detail: str = ""
    """A sentence, where there is more to say."""


@contextmanager
def robot(scene: SceneConfig) -> Iterator[tuple[Executor, World, Watch]]:
    """Yield what moves a lock-step arm that stands at home, its world, and an observer."""
    rig = make_rig(scene, lockstep=True)
    assert rig.call_every_tick is not None
    servo, watch = Servo(rig.arm, rig.clock, guard=Guard()), Watch(rig.world)
    with ExitStack() as undo:
        servo.connect()
        undo.callback(servo.disconnect)
        rig.call_every_tick(servo.tick)
        rig.call_every_tick(watch.tick)
        servo.claim("bench")
        yield Executor(servo, rig.clock), rig.world, watch


def look(scene: SceneConfig) -> tuple[RgbdFrame, np.ndarray]:
    """Return the camera's frame from home and the joints (7,) it was taken at [rad]."""
    rig = make_rig(scene, lockstep=True)
    assert rig.call_every_tick is not None
    servo = Servo(rig.arm, rig.clock, guard=Guard())
    with ExitStack() as undo:
        servo.connect()
        undo.callback(servo.disconnect)
        rig.call_every_tick(servo.tick)
        rig.camera.connect()
        undo.callback(rig.camera.disconnect)
        state = Executor(servo, rig.clock).settle()
        return rig.camera.wait_for_frame(1.0), state.q


def carry(kinematics: Kinematics, plan: GraspPlan, limits: MotionLimits) -> JointTrajectory | None:
    """Return the 30 mm sideways move that follows the lift: towards the middle if it can be, else another way."""
    start = plan.lift.q[-1]
    T = kinematics.pivot(start[:6])
    inwards = -np.sign(T[1, 3]) or 1.0
    for aside in ((0.0, inwards), (0.0, -inwards), (-1.0, 0.0), (1.0, 0.0)):
        T_goal = T.copy()
        T_goal[:2, 3] += ASIDE_M * np.array(aside)
        try:
            return straight_move(kinematics, T, T_goal, start, float(start[-1]), limits)
        except PathFailure:
            continue
    return None


def act(
    scene: SceneConfig, plan: GraspPlan, kinematics: Kinematics, limits: MotionLimits
) -> tuple[Outcome, np.ndarray]:
    """Execute `plan` in a fresh world; return how it ended and the final MuJoCo positions (14,)."""
    aside = carry(kinematics, plan, limits)
    with robot(scene) as (executor, world, watch):
        if aside is None:
            detail = "the lifted object cannot be moved 30 mm to any side."
            return Outcome(mode=Mode.NO_PATH, detail=detail), world.data.qpos.copy()
        start_s = world.time_s
        known: dict[str, Any] = {}
        closed = None
        try:
            for motion in (plan.transfer, plan.approach):
                executor.execute(motion)
                executor.settle()
            known |= {"displacement_m": watch.displacement_m, "tilt_rad": watch.tilt_rad}
            executor.execute(plan.close)
            state = executor.settle()
            closed = watch.T_hand_object()
            known |= {
                "jaws_touching": watch.jaws_touching(),
                "jaw": float(state.q[-1]),
                "jaw_torque_nm": float(state.tau[-1]),
            }
            for motion in (plan.lift, aside):
                executor.execute(motion)
                executor.settle()
            watch.clear()
            executor.execute(hold(aside.q[-1], HOLD_S))
        except (MotionError, HalError) as error:
            known["table_force_n"] = watch.table_force_n
            return Outcome(mode=Mode.STOPPED, detail=str(error), **known), world.data.qpos.copy()
        slip_m = float(np.linalg.norm(watch.T_hand_object()[:3, 3] - closed[:3, 3]))
        outcome = Outcome(
            mode=Mode.SUCCESS,
            table_force_n=watch.table_force_n,
            slip_m=slip_m,
            lifted_m=min(watch.lifted_m),
            duration_s=world.time_s - start_s,
            **known,
        )
        return _judged(outcome), world.data.qpos.copy()


def _judged(outcome: Outcome) -> Outcome:
    """Return `outcome` with the mode that its figures give; of several causes the first in time."""
    if outcome.lifted_m >= UP_M and outcome.slip_m < SLIP_M:
        return outcome
    if outcome.table_force_n > _TABLE_N:
        mode = Mode.TABLE_COLLISION
    elif outcome.displacement_m > _KNOCKED_M or outcome.tilt_rad > _KNOCKED_RAD:
        mode = Mode.KNOCKED
    elif outcome.jaws_touching < 2:
        mode = Mode.MISSED
    elif outcome.lifted_m >= UP_M:
        mode = Mode.SLIPPED
    else:
        mode = Mode.DROPPED
    return replace(outcome, mode=mode)
