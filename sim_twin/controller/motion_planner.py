"""Motions that the controller executes by itself: a request's body in, paths out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.base import z1
from hal.base.z1_kinematics import PivotKinematics, pose_from_posture, posture_from_pose
from hal.z1_protocol.controller import LABELS, Command, TrajectoryCommand
from hal.z1_protocol.states import Fsm
from sim_twin.controller.paths import JointPath, Path, Recording
from sim_twin.controller.pivot_paths import ArcPath, LinePath

LABEL_SPEED = 1.0
"""Speed of the fastest joint towards a label [rad/s] (measured on the vendor's controller)."""
TEACH_PERIOD_S = 0.02
"""Period of the points of a recording [s]; the vendor's was not measured."""

# Speed of a move that requests none [rad/s for MOVEJ, m/s for the others], and of the demonstration [rad/s] (measured).
_DEFAULT_SPEED = {Fsm.MOVEJ: 1.0, Fsm.MOVEL: 0.3, Fsm.MOVEC: 0.3}
_SHOW_SPEED = 2.0
_SHOW_GRIPPER_RAD = -np.pi / 3.0
_MAX_POSE = 100.0  # [rad, m]; poses beyond are garbage, and would overflow the inverse kinematics


class Motion(NamedTuple):
    """Paths, one after the other; none when the motion is impossible."""

    paths: tuple[Path, ...] = ()
    repeat_from: int | None = None
    """First of the paths that are repeated for ever."""


class MotionPlanner:
    """Labels, recordings and the plans of the controller's own motions."""

    def __init__(self) -> None:
        self.labels = {name: q.copy() for name, q in LABELS.items()}
        """Saved poses (6,) [rad]."""
        self.recordings: dict[str, np.ndarray] = {}
        """Taught motions (N, 7) [rad], one row every `TEACH_PERIOD_S`."""
        self.kinematics = PivotKinematics()
        """Kinematics of the pivot, for this thread."""
        self.kinematics.inverse(np.eye(4), np.zeros(z1.N_ARM))  # the solver compiles itself at its first use

    def posture(self, q: np.ndarray) -> np.ndarray:
        """Return the posture (6,) [rad, m] of the pivot at arm joints `q` (6,) [rad]."""
        return posture_from_pose(self.kinematics.forward(q))

    def plan(self, command: Command, state: Fsm, start: np.ndarray, measured: np.ndarray) -> Motion:
        """Return the motion of a state.

        Args:
            command: its body.
            state: the state.
            start: (7,) reference of the position servos [rad].
            measured: (7,) measured joints [rad], from which MOVEC starts (measured on the vendor's controller).

        Raises:
            ProtocolError: the body does not fit the state.
        """
        match state:
            case Fsm.BACKTOSTART:
                goal = np.append(self.labels["startFlat"], z1.GRIPPER_CLOSED)
                return Motion((JointPath(start, goal, LABEL_SPEED),))
            case Fsm.MOVEJ | Fsm.MOVEL | Fsm.MOVEC:
                if state is Fsm.MOVEC:
                    start = np.append(measured[: z1.N_ARM], start[z1.N_ARM])
                return self._plan_move(command.trajectory(), state, start)
            case Fsm.TRAJECTORY:
                return self._plan_show(start)
            case _:
                return self._plan_label(command.label(), state, start)

    def _plan_label(self, label: str, state: Fsm, start: np.ndarray) -> Motion:
        if state is Fsm.TOSTATE:
            if label not in self.labels:
                return Motion()
            return Motion((JointPath(start, np.append(self.labels[label], start[z1.N_ARM]), LABEL_SPEED),))
        if label not in self.recordings:
            return Motion()
        taught = self.recordings[label]
        return Motion((JointPath(start, taught[0], LABEL_SPEED), Recording(taught, TEACH_PERIOD_S)))

    def _plan_show(self, start: np.ndarray) -> Motion:
        """Return the demonstration: to both sides, with the jaws opening and closing."""
        middle = np.append(self.labels["show_mid"], z1.GRIPPER_CLOSED)
        paths: list[Path] = [JointPath(start, middle, LABEL_SPEED)]
        for label in ("show_left", "show_right"):
            side = np.append(self.labels[label], _SHOW_GRIPPER_RAD)
            paths += [JointPath(middle, side, _SHOW_SPEED), JointPath(side, middle, _SHOW_SPEED)]
        return Motion(tuple(paths), repeat_from=1)

    def _plan_move(self, move: TrajectoryCommand, state: Fsm, start: np.ndarray) -> Motion:
        gripper = float(np.clip(move.gripper_rad, z1.GRIPPER_OPEN, z1.GRIPPER_CLOSED))
        if not (np.abs(move.poses) <= _MAX_POSE).all():
            return Motion()
        speed = move.max_speed if move.max_speed > 0.0 else _DEFAULT_SPEED[state]
        goals = [pose_from_posture(posture) for posture in move.poses[: 2 if state is Fsm.MOVEC else 1]]
        found = [q for goal in goals if (q := self.kinematics.inverse(goal, start[: z1.N_ARM])) is not None]
        if len(found) < len(goals):
            return Motion()
        if state is Fsm.MOVEL:
            return Motion((LinePath(self.kinematics, start, goals[0], gripper, speed),))
        if state is Fsm.MOVEC:
            return Motion((ArcPath(self.kinematics, start, np.array(goals)[:, :3, 3], gripper, speed),))
        return Motion((JointPath(start, np.append(found[0], gripper), speed),))
