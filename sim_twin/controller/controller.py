"""Model of the vendor's controller: states, paths and rates over commands, measurements and elapsed time.

It follows the measurements of the vendor's controller, faults included: no watchdog, no position limit while tracking,
no torque limit in LOWCMD. Unmeasured behaviour is marked where it is decided. SETTRAJ, TRAJECTORY and NEXT, whose
behaviour is unknown, are ignored.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hal.base import z1
from hal.base.z1_dynamics import FeedForward
from hal.base.z1_kinematics import PivotKinematics, pose_from_posture, posture_from_pose
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
from hal.z1_protocol.states import MOVES, Fsm, is_granted
from sim_twin.controller.paths import MIN_DURATION_S, JointPath, plan_arc_path, plan_joint_path, plan_line_path

TRACKING_SPEED = np.pi
"""Maximum speed of a joint towards its target while tracking [rad/s] (measured on the vendor's controller)."""
LABEL_SPEED = 1.0
"""Speed of the fastest joint towards a label [rad/s]; the vendor's was not measured."""
TEACH_PERIOD_S = 0.02
"""Period of the points of a recording [s]; the vendor's was not measured."""
MAX_TEACHING_S = 300.0
"""Maximum length of a recording [s], which bounds its memory."""

_UNKNOWN = frozenset({Fsm.SETTRAJ, Fsm.TRAJECTORY, Fsm.NEXT})
_STIFF = frozenset({Fsm.JOINTCTRL, Fsm.CARTESIAN}) | MOVES
_FRESH_S = 0.02  # validity of the speed in a tracking command [s]; the vendor's was not measured
# [rad/s, m/s]; the duration of a motion divides by it
_MIN_SPEED = 1e-3
_MAX_POSE = 100.0  # [rad, m]; poses beyond are garbage, and would overflow the inverse kinematics
# Maximum change of a joint from the reference while tracking a pose [rad]: a larger one jumps to another branch.
_MAX_CHANGE_RAD = 0.5
_NO_SPEED = np.zeros(z1.N_JOINTS)
_NO_SPEED.setflags(write=False)


class Controller:
    """Controller of one arm; it starts in PASSIVE.

    Args:
        measured: the first measurement.
    """

    def __init__(self, measured: JointStates) -> None:
        self.fsm = Fsm.PASSIVE
        """Present state."""
        self.measured = measured
        """The last measurement, as it is reported: relative to the calibrated zero."""
        self.labels = {name: q.copy() for name, q in LABELS.items()}
        """Saved poses (6,) [rad]; the vendor's show_left, show_mid and show_right have to be saved first."""
        self.recordings: dict[str, np.ndarray] = {}
        """Taught motions (N, 7) [rad], one row every `TEACH_PERIOD_S`."""
        self.zero = np.zeros(z1.N_JOINTS)
        """(7,) zero of the joints set by CALIBRATION [rad]."""
        self._feed_forward = FeedForward()
        self._kinematics = PivotKinematics()
        self._kinematics.inverse(np.eye(4), np.zeros(z1.N_ARM))  # the solver compiles itself at its first use
        self._q = measured.q.copy()  # reference of the position servos
        self._target = self._q
        self._speed = _NO_SPEED
        self._track_age_s = np.inf
        self._low_level = JointCommands()
        self._paths: list[JointPath] = []
        self._time_s = 0.0  # since the start of the present path, teaching or calibration
        self._lesson = ""
        self._taught: list[np.ndarray] = []

    # --- Commands ---------------------------------------------------------------------------------------------------

    def handle_command(self, command: Command) -> None:
        """Execute a command; a request that is not granted is ignored, as by the vendor's controller.

        Raises:
            ProtocolError: the body does not fit the state; nothing has changed.
        """
        if command.state in (Fsm.INVALID, self.fsm):
            self._follow(command)
        elif is_granted(self.fsm, command.state) and command.state not in _UNKNOWN:
            self._enter(command)

    def _follow(self, command: Command) -> None:
        if self.fsm is Fsm.LOWCMD:
            self._low_level = command.joints()
        elif self.fsm is Fsm.JOINTCTRL and command.track:
            joints = command.joints()
            # Unlimited: the vendor's controller followed a target of 5.0 rad beyond joint 1's limit of 2.618
            self._target, self._speed, self._track_age_s = joints.q, joints.dq, 0.0
        elif self.fsm is Fsm.CARTESIAN and command.track:
            move = command.trajectory()
            if not _is_plausible(move):
                return
            q = self._kinematics.inverse(pose_from_posture(move.poses[0]), self._q[: z1.N_ARM], _MAX_CHANGE_RAD)
            if q is not None:
                self._target = np.append(q, _clip_jaw(move.gripper_rad))

    def _enter(self, command: Command) -> None:
        state = command.state
        # Out of a state without position control the arm is where it was moved to, not at the reference
        start = self._q if self.fsm in _STIFF else self.measured.q.copy()
        paths = self._plan(command, start) if state in MOVES else []
        low = command.joints() if state is Fsm.LOWCMD else self._low_level
        lesson = command.label() if state is Fsm.TEACH else ""
        # A path needs two points
        if self.fsm is Fsm.TEACH and len(self._taught) > 1:
            self.recordings[self._lesson] = np.array(self._taught)
        # Nothing raises from here on.
        if state in MOVES and not paths:
            state = Fsm.JOINTCTRL
        self.fsm, self._paths, self._low_level, self._lesson = state, paths, low, lesson
        self._taught = []
        self._hold(start)

    def _hold(self, q: np.ndarray) -> None:
        self._q = self._target = q
        self._speed, self._track_age_s, self._time_s = _NO_SPEED, np.inf, 0.0

    def _plan(self, command: Command, start: np.ndarray) -> list[JointPath]:
        """Return the paths of a motion, one after the other; none when it is impossible."""
        match command.state:
            case Fsm.BACKTOSTART:
                return [self._to_label("startFlat", start)]
            case Fsm.MOVEJ | Fsm.MOVEL | Fsm.MOVEC:
                return self._plan_move(command, start)
        label = command.label()
        if command.state is Fsm.SAVESTATE:
            self.labels[label] = self.measured.q[: z1.N_ARM].copy()
            return [plan_joint_path(start, start, LABEL_SPEED)]
        if command.state is Fsm.TOSTATE:
            return [self._to_label(label, start)] if label in self.labels else []
        if label not in self.recordings:
            return []
        taught = self.recordings[label]
        replay = JointPath(taught, (len(taught) - 1) * TEACH_PERIOD_S, recorded=True)
        return [plan_joint_path(start, taught[0], LABEL_SPEED), replay]

    def _to_label(self, label: str, start: np.ndarray) -> JointPath:
        return plan_joint_path(start, np.append(self.labels[label], start[z1.N_ARM]), LABEL_SPEED)

    def _plan_move(self, command: Command, start: np.ndarray) -> list[JointPath]:
        move = command.trajectory()
        gripper = _clip_jaw(move.gripper_rad)
        if move.max_speed < _MIN_SPEED or not _is_plausible(move):
            return []
        if command.state is Fsm.MOVEL:
            path = plan_line_path(self._kinematics, start, move.poses[0], gripper, move.max_speed)
        elif command.state is Fsm.MOVEC:
            path = plan_arc_path(self._kinematics, start, move.poses, gripper, move.max_speed)
        else:
            q = self._kinematics.inverse(pose_from_posture(move.poses[0]), start[: z1.N_ARM])
            path = None if q is None else plan_joint_path(start, np.append(q, gripper), move.max_speed)
        return [path] if path is not None else []

    # --- Time -------------------------------------------------------------------------------------------------------

    def step(self, measured: JointStates, dt_s: float) -> JointCommands:
        """Advance by `dt_s` [s]; return the commands for the motors, (7,) each, in the motors' own zero.

        Args:
            measured: the newest measurement of the motors.
            dt_s: time since the last step [s].
        """
        self.measured = replace(measured, q=measured.q - self.zero)
        self._time_s += dt_s
        self._track_age_s += dt_s
        if self.fsm is Fsm.CALIBRATION and self._time_s >= MIN_DURATION_S:
            self.zero[: z1.N_ARM] = measured.q[: z1.N_ARM]
            self.fsm = Fsm.PASSIVE
        match self.fsm:
            case Fsm.PASSIVE | Fsm.CALIBRATION:
                commands = JointCommands(q=self.measured.q, kd=KD_PASSIVE)
            case Fsm.LOWCMD:
                # Measured on the vendor's controller: 9 rad and 50 rad/s were limited, a torque of 700 Nm was not
                q, dq = (
                    np.clip(self._low_level.q, z1.Q_MIN, z1.Q_MAX),
                    np.clip(self._low_level.dq, -z1.DQ_MAX, z1.DQ_MAX),
                )
                commands = replace(self._low_level, q=q, dq=dq)
            case Fsm.TEACH:
                self._record()
                commands = JointCommands(q=self.measured.q, kd=KD_PASSIVE, tau=self._gravity())
            case _:
                dq = self._advance(dt_s)
                commands = JointCommands(q=self._q, dq=dq, tau=self._gravity(), kp=KP_JOINTCTRL, kd=KD_JOINTCTRL)
        return replace(commands, q=commands.q + self.zero)

    def answer(self) -> ControllerState:
        """Return the answer to a client."""
        pose = posture_from_pose(self._kinematics.forward(self.measured.q[: z1.N_ARM]))
        return ControllerState(state=self.fsm, joints=self.measured, pose=pose)

    def _advance(self, dt_s: float) -> np.ndarray:
        """Advance the reference; return its speed (7,) [rad/s]."""
        if self._paths:
            path = self._paths[0]
            self._q, dq = path.sample(self._time_s)
            if self._time_s >= path.duration_s:
                # The rest of this step belongs to the next path
                self._time_s -= path.duration_s
                del self._paths[0]
                if not self._paths:
                    self.fsm = Fsm.JOINTCTRL
                    self._hold(self._q)
            return dq
        reach, distance = TRACKING_SPEED * dt_s, self._target - self._q
        step = np.clip(distance, -reach, reach)
        self._q = self._q + step
        speed = np.clip(self._speed, -TRACKING_SPEED, TRACKING_SPEED) if self._track_age_s <= _FRESH_S else _NO_SPEED
        # At the target the client's speed is fed forward, on the way to it that of the rate limit
        return np.where(step == distance, speed, step / dt_s)

    def _record(self) -> None:
        if self._time_s >= len(self._taught) * TEACH_PERIOD_S and self._time_s <= MAX_TEACHING_S:
            self._taught.append(self.measured.q)

    def _gravity(self) -> np.ndarray:
        return self._feed_forward.torque(self.measured.q, _NO_SPEED)


def _is_plausible(move: TrajectoryCommand) -> bool:
    """Return whether the poses are within the range of the calculations."""
    return bool((np.abs(move.poses) <= _MAX_POSE).all())


def _clip_jaw(angle: float) -> float:
    return float(np.clip(angle, z1.GRIPPER_OPEN, z1.GRIPPER_CLOSED))
