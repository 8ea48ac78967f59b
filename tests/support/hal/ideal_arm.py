"""Controller of the twin whose motors are ideal, and requests for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from hal.base.z1_kinematics import PivotKinematics, posture_from_pose
from hal.z1_protocol.controller import LABELS, TrajectoryCommand, decode_command, encode_command
from hal.z1_protocol.motor_board import PERIOD_S
from hal.z1_protocol.records import JointCommands, JointStates
from hal.z1_protocol.states import MOVES, Fsm
from sim_twin.controller.controller import Controller

START = np.append(z1.Q_HOME, -0.5)


class IdealArm:
    """A controller whose motors are at their commanded positions, or where a test sets them."""

    def __init__(self, q: np.ndarray = START) -> None:
        self.states = JointStates(q=q.copy())
        self.controller = Controller(self.states)
        self.command = decode_command(encode_command(Fsm.INVALID))
        self.commands = JointCommands()
        self.max_speed = 0.0

    def request(
        self, state: Fsm, body: JointCommands | TrajectoryCommand | str | None = None, track: bool = False
    ) -> Fsm:
        """Request a state for the two steps that a change takes, then none with the same body; return the state."""
        self.command = decode_command(encode_command(state, body, track=track))
        self.run(2 * PERIOD_S)
        self.command = replace(self.command, state=Fsm.INVALID)
        return self.controller.fsm

    def track(self, body: JointCommands | TrajectoryCommand) -> None:
        self.command = decode_command(encode_command(Fsm.INVALID, body, track=True))

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / PERIOD_S)):
            self.commands = self.controller.step(self.command, self.states, PERIOD_S)
            if self.commands.kp.any() and self.controller.fsm is not Fsm.LOWCMD:
                step = np.abs(self.commands.q - self.states.q).max() / PERIOD_S
                self.max_speed = max(self.max_speed, float(step))
                q = self.commands.q
            else:
                q = self.states.q
            self.states = replace(self.states, q=q)  # a new measurement, as the board is not silent

    def finish(self, timeout_s: float = 20.0) -> None:
        for _ in range(round(timeout_s / 0.1)):
            if self.controller.fsm not in MOVES:
                return
            self.run(0.1)
        pytest.fail(f"still in {self.controller.fsm.name}")

    @property
    def pose(self) -> np.ndarray:
        return self.controller.answer().pose


def pose_at(q: np.ndarray) -> np.ndarray:
    return posture_from_pose(PivotKinematics().forward(q[:6]))


def shift(posture: np.ndarray, *by: float) -> np.ndarray:
    return posture + np.array(by)


def move_to(*postures: np.ndarray, gripper: float = -0.5, speed: float = 1.0) -> TrajectoryCommand:
    poses = np.zeros((2, 6))
    poses[: len(postures)] = postures
    return TrajectoryCommand(poses=poses, gripper_rad=gripper, max_speed=speed)


def make_body(requested: Fsm) -> JointCommands | TrajectoryCommand | str | None:
    match requested:
        case Fsm.MOVEJ | Fsm.MOVEL:
            return move_to(pose_at(LABELS["forward"]))
        case Fsm.MOVEC:
            here = pose_at(START)
            return move_to(shift(here, 0, 0, 0, 0.02, 0.02, 0), shift(here, 0, 0, 0, 0, 0.04, 0))
        case Fsm.TOSTATE:
            return "forward"
        case Fsm.SAVESTATE | Fsm.TEACH:
            return "mine"
        case Fsm.TEACHREPEAT:
            return "known"
        case _:
            return None
