"""The vendor's controller as a function of commands, measurements and elapsed time: its states, ways and rates.

Everything of the measured table is kept, faults included: no watchdog, no position limit while tracking, no torque
limit in LOWCMD. What was never measured is said where it is decided. SETTRAJ, TRAJECTORY and NEXT, of which nothing is
known, are ignored.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hal.backends.z1.torque import FeedForward
from hal.base import z1
from hal.compat.unitree_arm_interface.model import Z1Model, homoToPosture, postureToHomo
from hal.z1_protocol.controller import (
    KD_JOINTCTRL,
    KD_PASSIVE,
    KP_JOINTCTRL,
    LABELS,
    Command,
    ControllerState,
    TrajectoryCommand,
)
from hal.z1_protocol.records import JointCommands, JointStates
from hal.z1_protocol.states import MOVES, Fsm, granted
from sim_twin.controller.paths import SHORTEST_S, Path, arc_path, joint_path, line_path

TRACKING_SPEED = np.pi
"""Of a joint that catches up with its target while tracking [rad/s] (wire)."""
LABEL_SPEED = 1.0
"""Of the fastest joint on the way to a label [rad/s]; the vendor's was not measured."""
TEACH_PERIOD_S = 0.02
"""Between two points of a recording [s]; the vendor's was not measured."""
LONGEST_TEACHING_S = 300.0
"""A recording ends then [s]."""

_UNKNOWN = frozenset({Fsm.SETTRAJ, Fsm.TRAJECTORY, Fsm.NEXT})
_STIFF = frozenset({Fsm.JOINTCTRL, Fsm.CARTESIAN}) | MOVES
_FRESH_S = 0.02  # for so long after it came the speed in a tracking command counts; not measured
_SLOWEST = 1e-3
_FAR = 100.0
_NO_SPEED = np.zeros(z1.N_JOINTS)
_NO_SPEED.setflags(write=False)


class Controller:
    """One arm's controller, switched on: in PASSIVE.

    Args:
        measured: the first measurement.
    """

    def __init__(self, measured: JointStates) -> None:
        self.fsm = Fsm.PASSIVE
        """What it is doing."""
        self.measured = measured
        """The last measurement, as it is told: relative to the calibrated zero."""
        self.labels = {name: q.copy() for name, q in LABELS.items()}
        """Saved poses (6,) [rad]; the vendor's show_left, show_mid and show_right have to be saved first."""
        self.recordings: dict[str, np.ndarray] = {}
        """Taught motions (N, 7) [rad], one row every `TEACH_PERIOD_S`."""
        self.zero = np.zeros(z1.N_JOINTS)
        """(7,) what CALIBRATION made the zero of the joints [rad]."""
        self._gravity = FeedForward()
        self._model = Z1Model.with_gripper()
        self._model.inverseKinematics(np.eye(4), np.zeros(z1.N_ARM))  # the solver compiles itself at its first use
        self._q = measured.q.copy()  # the reference: where the servos pull to
        self._target = self._q
        self._speed = _NO_SPEED
        self._track_age_s = np.inf
        self._low = JointCommands()
        self._paths: list[Path] = []
        self._time_s = 0.0  # in the present path, teaching or calibration
        self._lesson = ""
        self._taught: list[np.ndarray] = []

    # --- Commands ---------------------------------------------------------------------------------------------------

    def obey(self, command: Command) -> None:
        """Take a command; one that is not granted is ignored, as by the vendor's.

        Raises:
            WireError: the body is not what the state needs; nothing has changed.
        """
        if command.state in (Fsm.INVALID, self.fsm):
            self._follow(command)
        elif granted(self.fsm, command.state) and command.state not in _UNKNOWN:
            self._enter(command)

    def _follow(self, command: Command) -> None:
        if self.fsm is Fsm.LOWCMD:
            self._low = command.joints()
        elif self.fsm is Fsm.JOINTCTRL and command.track:
            joints = command.joints()
            self._target, self._speed, self._track_age_s = joints.q, joints.dq, 0.0
        elif self.fsm is Fsm.CARTESIAN and command.track:
            move = command.trajectory()
            if not _near(move):
                return
            found, q = self._model.inverseKinematics(postureToHomo(move.poses[0]), self._q[: z1.N_ARM])
            if found:
                self._target = np.append(q, _jaw(move.gripper_rad))

    def _enter(self, command: Command) -> None:
        state = command.state
        start = self._q if self.fsm in _STIFF else self.measured.q.copy()
        paths = self._plan(command, start) if state in MOVES else []
        low = command.joints() if state is Fsm.LOWCMD else self._low
        lesson = command.label() if state is Fsm.TEACH else ""
        if self.fsm is Fsm.TEACH and len(self._taught) > 1:
            self.recordings[self._lesson] = np.array(self._taught)
        # Nothing raises from here on.
        if state in MOVES and not paths:
            state = Fsm.JOINTCTRL
        self.fsm, self._paths, self._low, self._lesson = state, paths, low, lesson
        self._taught = []
        self._hold(start)

    def _hold(self, q: np.ndarray) -> None:
        self._q = self._target = q
        self._speed, self._track_age_s, self._time_s = _NO_SPEED, np.inf, 0.0

    def _plan(self, command: Command, start: np.ndarray) -> list[Path]:
        """Return the ways of a motion, one after the other; none when it cannot be made."""
        match command.state:
            case Fsm.BACKTOSTART:
                return [self._to_label("startFlat", start)]
            case Fsm.MOVEJ | Fsm.MOVEL | Fsm.MOVEC:
                return self._plan_move(command, start)
        label = command.label()
        if command.state is Fsm.SAVESTATE:
            self.labels[label] = self.measured.q[: z1.N_ARM].copy()
            return [joint_path(start, start, LABEL_SPEED)]
        if command.state is Fsm.TOSTATE:
            return [self._to_label(label, start)] if label in self.labels else []
        if label not in self.recordings:
            return []
        taught = self.recordings[label]
        replay = Path(taught, (len(taught) - 1) * TEACH_PERIOD_S, even=True)
        return [joint_path(start, taught[0], LABEL_SPEED), replay]

    def _to_label(self, label: str, start: np.ndarray) -> Path:
        return joint_path(start, np.append(self.labels[label], start[z1.N_ARM]), LABEL_SPEED)

    def _plan_move(self, command: Command, start: np.ndarray) -> list[Path]:
        move = command.trajectory()
        gripper = _jaw(move.gripper_rad)
        if move.max_speed < _SLOWEST or not _near(move):
            return []
        if command.state is Fsm.MOVEL:
            path = line_path(self._model, start, move.poses[0], gripper, move.max_speed)
        elif command.state is Fsm.MOVEC:
            path = arc_path(self._model, start, move.poses, gripper, move.max_speed)
        else:
            goal = postureToHomo(move.poses[0])
            found, q = self._model.inverseKinematics(goal, start[: z1.N_ARM], True)
            path = joint_path(start, np.append(q, gripper), move.max_speed) if found else None
        return [path] if path is not None else []

    # --- Time -------------------------------------------------------------------------------------------------------

    def step(self, measured: JointStates, dt_s: float) -> JointCommands:
        """Let `dt_s` [s] pass; return what the motors are told, (7,) each, torques and positions as they need them.

        Args:
            measured: the newest measurement of the motors.
            dt_s: since the last step.
        """
        self.measured = replace(measured, q=measured.q - self.zero)
        self._time_s += dt_s
        self._track_age_s += dt_s
        if self.fsm is Fsm.CALIBRATION and self._time_s >= SHORTEST_S:
            self.zero[: z1.N_ARM] = measured.q[: z1.N_ARM]
            self.fsm = Fsm.PASSIVE
        match self.fsm:
            case Fsm.PASSIVE | Fsm.CALIBRATION:
                told = JointCommands(q=self.measured.q, kd=KD_PASSIVE)
            case Fsm.LOWCMD:
                q, dq = np.clip(self._low.q, z1.Q_MIN, z1.Q_MAX), np.clip(self._low.dq, -z1.DQ_MAX, z1.DQ_MAX)
                told = replace(self._low, q=q, dq=dq)
            case Fsm.TEACH:
                self._record()
                told = JointCommands(q=self.measured.q, kd=KD_PASSIVE, tau=self._weight())
            case _:
                dq = self._advance(dt_s)
                told = JointCommands(q=self._q, dq=dq, tau=self._weight(), kp=KP_JOINTCTRL, kd=KD_JOINTCTRL)
        return replace(told, q=told.q + self.zero)

    def answer(self) -> ControllerState:
        """Return what it tells a client."""
        pose = homoToPosture(self._model.forwardKinematics(self.measured.q[: z1.N_ARM]))
        return ControllerState(state=self.fsm, joints=self.measured, pose=pose)

    def _advance(self, dt_s: float) -> np.ndarray:
        """Move the reference on; return its speed (7,) [rad/s]."""
        if self._paths:
            path = self._paths[0]
            self._q, dq = path.at(self._time_s)
            if self._time_s >= path.duration_s:
                self._time_s -= path.duration_s
                del self._paths[0]
                if not self._paths:
                    self.fsm = Fsm.JOINTCTRL
                    self._hold(self._q)
            return dq
        reach, way = TRACKING_SPEED * dt_s, self._target - self._q
        step = np.clip(way, -reach, reach)
        self._q = self._q + step
        asked = np.clip(self._speed, -TRACKING_SPEED, TRACKING_SPEED) if self._track_age_s <= _FRESH_S else _NO_SPEED
        return np.where(step == way, asked, step / dt_s)

    def _record(self) -> None:
        if self._time_s >= len(self._taught) * TEACH_PERIOD_S and self._time_s <= LONGEST_TEACHING_S:
            self._taught.append(self.measured.q)

    def _weight(self) -> np.ndarray:
        return self._gravity.torque(self.measured.q, _NO_SPEED)


def _near(move: TrajectoryCommand) -> bool:
    """Whether the poses are such that calculating with them makes sense."""
    return bool((np.abs(move.poses) <= _FAR).all())


def _jaw(angle: float) -> float:
    return float(np.clip(angle, z1.GRIPPER_OPEN, z1.GRIPPER_CLOSED))
