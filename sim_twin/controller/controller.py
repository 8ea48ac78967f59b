"""State machine of the vendor's controller: commands, measurements and elapsed time in, motor commands out.

It follows the measurements of the vendor's controller, faults included: no position limit while tracking, no torque
limit in LOWCMD, and a state request in LOWCMD is obeyed as a motor command. Unmeasured behaviour is marked where it is
decided.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hal.base import z1
from hal.z1_protocol.controller import KP_JOINTCTRL, Command, ControllerState
from hal.z1_protocol.records import JointCommands, JointStates, MotorError, ProtocolError
from hal.z1_protocol.states import MOVES, Fsm, is_granted
from sim_twin.controller.behaviours import (
    KP_HOLDING,
    Behaviour,
    Damping,
    Following,
    Forwarding,
    Servos,
    Teaching,
    Tracking,
    TwistTracking,
)
from sim_twin.controller.motion_planner import Motion, MotionPlanner

CALIBRATION_S = 2.0
"""Time for which the state machine waits for the motor board's calibration, before CALIBRATION is shown [s]."""
BOARD_TIMEOUT_S = 2.2
"""Silence of the motor board after which the controller falls to PASSIVE [s]."""

_RELEASING = np.uint8(MotorError.OVER_CURRENT | MotorError.LEAKAGE | MotorError.OVERHEAT)
_KP: dict[Fsm, np.ndarray] = dict.fromkeys((Fsm.MOVEJ, Fsm.MOVEL, Fsm.MOVEC, Fsm.TEACHREPEAT), KP_HOLDING)


class Controller:
    """Controller of one arm; it starts in PASSIVE.

    A request takes effect in two steps, as in the vendor's: in the first the present state runs once more, with the
    request's body as its command; in the second the new state begins, with the body that is the newest by then. A
    motor's over-current, leakage or overheat and a silent motor board request PASSIVE; a lost motor does not.

    Args:
        measured: the first measurement.
    """

    def __init__(self, measured: JointStates) -> None:
        self.fsm = Fsm.PASSIVE
        """Present state."""
        self.measured = measured
        """The last measurement, as it is reported: relative to the calibrated zero."""
        self.planner = MotionPlanner()
        """Labels and recordings."""
        self.zero = np.zeros(z1.N_JOINTS)
        """(7,) zero of the joints set by CALIBRATION [rad]."""
        self.invalid_bodies = 0
        """Commands whose body did not fit the state."""
        self.invalid_reason = ""
        """Reason for the last one."""
        self._servos = Servos()
        self._behaviour: Behaviour = Damping()
        self._lesson = ""
        self._granted: Fsm | None = None
        self._commands = JointCommands(q=measured.q)
        self._rejected: Command | None = None
        self._board_silent_s = self._calibrating_s = 0.0
        self._newest = measured

    def step(self, command: Command, measured: JointStates, dt_s: float) -> JointCommands:
        """Advance by `dt_s` [s]; return the commands for the motors, (7,) each, in the motors' own zero.

        Args:
            command: the client's newest command.
            measured: the newest measurement of the motors; the same object while their board is silent.
            dt_s: time since the last step [s].
        """
        if self._granted is Fsm.CALIBRATION and self._calibrating_s < CALIBRATION_S:
            self._calibrating_s += dt_s
            return replace(self._commands, q=self._commands.q + self.zero)
        self._calibrating_s = 0.0
        self._board_silent_s = self._board_silent_s + dt_s if measured is self._newest else 0.0
        self._newest = measured
        self.measured = replace(measured, q=measured.q - self.zero)
        if self._granted is not None:
            self._enter(self._granted, command, measured)
            self._granted = None
            self._run(command, dt_s)
        else:
            self._run(command, dt_s)
            self._granted = self._find_next(command.state)
        return replace(self._commands, q=self._commands.q + self.zero)

    def answer(self) -> ControllerState:
        """Return the answer to a client."""
        pose = self.planner.posture(self.measured.q[: z1.N_ARM])
        return ControllerState(state=self.fsm, joints=self.measured, pose=pose)

    def _run(self, command: Command, dt_s: float) -> None:
        try:
            self._commands = self._behaviour.step(command, self.measured.q, dt_s)
        except ProtocolError as error:  # the vendor's controller forwards such values; here the last command persists
            self._reject(command, error)

    def _reject(self, command: Command, error: ProtocolError) -> None:
        if command is not self._rejected:
            self._rejected = command
            self.invalid_bodies += 1
            self.invalid_reason = str(error)

    def _find_next(self, requested: Fsm) -> Fsm | None:
        if self._board_silent_s >= BOARD_TIMEOUT_S or (self.measured.error & _RELEASING).any():
            return None if self.fsm is Fsm.PASSIVE else Fsm.PASSIVE
        if self._behaviour.done:
            return Fsm.PASSIVE if self.fsm is Fsm.CALIBRATION else Fsm.JOINTCTRL
        if requested in (Fsm.INVALID, self.fsm) or not is_granted(self.fsm, requested):
            return None
        return Fsm.BACKTOSTART if requested is Fsm.NEXT else requested

    def _enter(self, state: Fsm, command: Command, measured: JointStates) -> None:
        if isinstance(self._behaviour, Teaching) and (recording := self._behaviour.recording) is not None:
            self.planner.recordings[self._lesson] = recording
        # The reference is the last command; in PASSIVE and TEACH that is the measurement
        start = self._commands.q
        match state:
            case Fsm.PASSIVE:
                self._behaviour = Damping()
            case Fsm.CALIBRATION:
                self.zero[: z1.N_ARM] = measured.q[: z1.N_ARM]
                self._behaviour = Damping(done=True)
            case Fsm.LOWCMD:
                self._behaviour = Forwarding()
            case Fsm.JOINTCTRL:
                self._behaviour = Tracking(start, self._servos)
            case Fsm.CARTESIAN:
                self._behaviour = TwistTracking(start, self._servos, self.planner.kinematics)
            case Fsm.TEACH:
                self._behaviour, self._lesson = Teaching(self._servos), self._read_label(command)
            case _:
                motion = self._plan(state, command, start)
                self._behaviour = Following(motion, start, self._servos, _KP.get(state, KP_JOINTCTRL))
        self.fsm = state

    def _plan(self, state: Fsm, command: Command, start: np.ndarray) -> Motion:
        if state is Fsm.SAVESTATE:
            if label := self._read_label(command):
                self.planner.labels[label] = self.measured.q[: z1.N_ARM].copy()
        elif state in MOVES:
            try:
                return self.planner.plan(command, state, start, self.measured.q)
            except ProtocolError as error:
                self._reject(command, error)
        return Motion()

    def _read_label(self, command: Command) -> str:
        try:
            return command.label()
        except ProtocolError as error:
            self._reject(command, error)
            return ""
