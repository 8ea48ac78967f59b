"""The vendor's small classes: measurements, commands of the low-level mode, and the controller's address."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from hal.backends.z1.config import Z1ArmConfig
from hal.backends.z1.faults import motor_values
from hal.base import z1
from hal.compat.unitree_arm_interface.model import Z1Model
from hal.z1_protocol.controller import COMMAND_PORT, KD_LOWCMD, KP_LOWCMD, STATE_PORT, STATE_SIZE, ControllerState
from hal.z1_protocol.states import Fsm

ArmFSMState = Fsm
"""The vendor's name of the controller's states."""
RECVSTATE_LENGTH = STATE_SIZE
_ARM = slice(z1.N_ARM)


class BlockYN(IntEnum):
    """Blocking mode of the vendor's port; accepted and ignored."""

    NO = 0
    YES = 1


@dataclass(frozen=True)
class UDPPort:
    """Address of a controller; `arm._ctrlComp.udp = UDPPort("127.0.0.1", 8073, 8074)` before `loopOn` sets another."""

    IP: str = "127.0.0.1"
    toPort: int = COMMAND_PORT
    ownPort: int = STATE_PORT
    stateLength: int = RECVSTATE_LENGTH
    blockYN: BlockYN = BlockYN.NO
    timeOutUs: int = 500_000

    @property
    def config(self) -> Z1ArmConfig:
        """Configuration of our driver; a controller on another machine answers to any of this one's addresses."""
        local = "127.0.0.1" if self.IP in ("127.0.0.1", "localhost") else "0.0.0.0"
        return Z1ArmConfig(host=self.IP, command_port=self.toPort, local_host=local, state_port=self.ownPort)


class LowlevelState:
    """Last measurement: seven joints, eight motors, and the gripper's posture."""

    def __init__(self) -> None:
        self.q, self.dq, self.ddq, self.tau = ([0.0] * z1.N_JOINTS for _ in range(4))
        self.temperature, self.errorstate, self.isMotorConnected = ([0] * (z1.N_JOINTS + 1) for _ in range(3))
        self.endPosture = np.zeros(6)

    def update(self, state: ControllerState) -> None:
        """Update from an answer of the controller."""
        joints = state.joints
        self.q, self.dq, self.ddq, self.tau = (v.tolist() for v in (joints.q, joints.dq, joints.ddq, joints.tau))
        self.temperature = motor_values(joints.temperature_c).tolist()
        self.errorstate = motor_values(joints.error & ~np.uint8(0x40)).tolist()  # MotorError.IGNORE
        self.isMotorConnected = motor_values(joints.link).tolist()
        self.endPosture = state.pose.copy()

    def getQ(self) -> np.ndarray:
        """Return the arm's positions (6,) [rad]."""
        return np.array(self.q[_ARM])

    def getQd(self) -> np.ndarray:
        """Return the arm's speeds (6,) [rad/s]."""
        return np.array(self.dq[_ARM])

    def getQdd(self) -> np.ndarray:
        """Return the arm's accelerations (6,) [rad/s²]."""
        return np.array(self.ddq[_ARM])

    def getTau(self) -> np.ndarray:
        """Return the arm's torques (6,) [Nm]."""
        return np.array(self.tau[_ARM])

    getQTau = getTau

    def getGripperQ(self) -> float:
        """Return the gripper's angle [rad]: −π/2 open, 0 closed."""
        return self.q[z1.N_ARM]

    def getGripperQd(self) -> float:
        """Return the gripper's speed [rad/s]."""
        return self.dq[z1.N_ARM]

    def getGripperTau(self) -> float:
        """Return the gripper's torque [Nm]."""
        return self.tau[z1.N_ARM]


class LowlevelCmd:
    """Gains of the low-level mode, in the vendor's units."""

    def __init__(self) -> None:
        self.kp, self.kd = KP_LOWCMD.tolist(), KD_LOWCMD.tolist()

    def setControlGain(self, KP: Sequence[float] | None = None, KW: Sequence[float] | None = None) -> None:
        """Set the arm's gains (6,); the default ones without arguments."""
        self.kp[_ARM] = list(KP_LOWCMD[_ARM] if KP is None else KP)[_ARM]
        self.kd[_ARM] = list(KD_LOWCMD[_ARM] if KW is None else KW)[_ARM]

    def setGripperGain(self, KP: float | None = None, KW: float | None = None) -> None:
        """Set the gripper's gains; the default ones without arguments."""
        self.kp[z1.N_ARM] = float(KP_LOWCMD[z1.N_ARM] if KP is None else KP)
        self.kd[z1.N_ARM] = float(KD_LOWCMD[z1.N_ARM] if KW is None else KW)

    def setZeroKp(self) -> None:
        """Set the stiffness of all joints to zero."""
        self.kp = [0.0] * z1.N_JOINTS

    def setZeroKd(self) -> None:
        """Set the damping of all joints to zero."""
        self.kd = [0.0] * z1.N_JOINTS

    def setGripperZeroGain(self) -> None:
        """Release the gripper: no stiffness, no damping."""
        self.setGripperGain(0.0, 0.0)


class RecvState:
    """Last answer of the controller."""

    def __init__(self, fsm: Callable[[], Fsm]) -> None:
        self._fsm = fsm

    @property
    def state(self) -> Fsm:
        """State of the controller."""
        return self._fsm()


class CtrlComponents:
    """Components of an `ArmInterface`."""

    def __init__(self, model: Z1Model, udp: UDPPort, recvState: RecvState) -> None:
        self.armModel = model
        self.dt = z1.CONTROL_PERIOD_S
        self.lowcmd = LowlevelCmd()
        self.lowstate = LowlevelState()
        self.recvState = recvState
        self.udp = udp
