"""Motions that the controller executes by itself: a request's body in, paths out."""

from __future__ import annotations

import numpy as np

from hal.base import z1
from hal.base.z1_kinematics import PivotKinematics, pose_from_posture, posture_from_pose
from hal.z1_protocol.controller import LABELS, Command, TrajectoryCommand
from hal.z1_protocol.states import Fsm
from sim_twin.controller.behaviours import TEACH_PERIOD_S
from sim_twin.controller.paths import JointPath, plan_arc_path, plan_joint_path, plan_line_path

LABEL_SPEED = 1.0
"""Speed of the fastest joint towards a label [rad/s] (measured on the vendor's controller)."""

# Speeds of a move that requests none or a negative one: [rad/s] for MOVEJ, [m/s] for the others (measured).
_DEFAULT_SPEED = {Fsm.MOVEJ: 1.0, Fsm.MOVEL: 0.3, Fsm.MOVEC: 0.3}
_MAX_POSE = 100.0  # [rad, m]; poses beyond are garbage, and would overflow the inverse kinematics


class MotionPlanner:
    """Labels, recordings and the plans of the controller's own motions."""

    def __init__(self) -> None:
        self.labels = {name: q.copy() for name, q in LABELS.items()}
        """Saved poses (6,) [rad]."""
        self.recordings: dict[str, np.ndarray] = {}
        """Taught motions (N, 7) [rad], one row every `TEACH_PERIOD_S`."""
        self._kinematics = PivotKinematics()
        self._kinematics.inverse(np.eye(4), np.zeros(z1.N_ARM))  # the solver compiles itself at its first use

    def posture(self, q: np.ndarray) -> np.ndarray:
        """Return the posture (6,) [rad, m] of the pivot at arm joints `q` (6,) [rad]."""
        return posture_from_pose(self._kinematics.forward(q))

    def plan(self, command: Command, state: Fsm, start: np.ndarray) -> list[JointPath]:
        """Return the paths of a motion from `start` (7,) [rad], one after the other; none when it is impossible.

        Raises:
            ProtocolError: the body does not fit the state.
        """
        match state:
            case Fsm.BACKTOSTART:
                return [plan_joint_path(start, np.append(self.labels["startFlat"], z1.GRIPPER_CLOSED), LABEL_SPEED)]
            case Fsm.MOVEJ | Fsm.MOVEL | Fsm.MOVEC:
                return self._plan_move(command.trajectory(), state, start)
            case Fsm.TRAJECTORY:
                return self._plan_show(start)
        label = command.label()
        if state is Fsm.TOSTATE:
            return [self._to_label(label, start)] if label in self.labels else []
        if label not in self.recordings:
            return []
        taught = self.recordings[label]
        replay = JointPath(taught, (len(taught) - 1) * TEACH_PERIOD_S, recorded=True)
        return [plan_joint_path(start, taught[0], LABEL_SPEED), replay]

    def _to_label(self, label: str, start: np.ndarray) -> JointPath:
        return plan_joint_path(start, np.append(self.labels[label], start[z1.N_ARM]), LABEL_SPEED)

    def _plan_show(self, start: np.ndarray) -> list[JointPath]:
        """Return one round of the demonstration, to both sides with the jaws opening and closing."""
        paths = []
        for label, gripper in (("show_mid", 0.0), ("show_right", -1.0), ("show_mid", 0.0), ("show_left", -1.0)):
            goal = np.append(self.labels[label], gripper)
            paths.append(plan_joint_path(start, goal, LABEL_SPEED))
            start = goal
        return paths

    def _plan_move(self, move: TrajectoryCommand, state: Fsm, start: np.ndarray) -> list[JointPath]:
        gripper = float(np.clip(move.gripper_rad, z1.GRIPPER_OPEN, z1.GRIPPER_CLOSED))
        if not (np.abs(move.poses) <= _MAX_POSE).all():
            return []
        speed = move.max_speed if move.max_speed > 0.0 else _DEFAULT_SPEED[state]
        if state is Fsm.MOVEL:
            path = plan_line_path(self._kinematics, start, move.poses[0], gripper, speed)
        elif state is Fsm.MOVEC:
            path = plan_arc_path(self._kinematics, start, move.poses, gripper, speed)
        else:
            q = self._kinematics.inverse(pose_from_posture(move.poses[0]), start[: z1.N_ARM])
            path = None if q is None else plan_joint_path(start, np.append(q, gripper), speed)
        return [path] if path is not None else []
