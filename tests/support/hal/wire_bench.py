"""Servo over the real Z1's driver over the twin's controller, in one process and on the twin's clock."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig, Z1Mode
from hal.backends.z1.torque_limits import motor_torques
from hal.base import z1
from hal.base.messages import ServoMode, ServoStatus, TrajectoryChunk
from hal.servo.servo import Servo
from hal.z1_protocol.records import JointCommands
from sim_twin.backends import TwinClock
from sim_twin.controller.controlled_world import ControlledWorld
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.faults_table import FaultsTable, describe
from tests.support.hal.twin_link import TwinLink

PERIOD_S = z1.CONTROL_PERIOD_S
MOVE_S = 1.2
FAULT_AT_S = 0.4
_MAX_S = 1.9
_BEAT_EVERY = 10
_HEARTBEAT_TIMEOUT_S = 0.15
_TOUCH_RAD = 5e-3
_MOVING_RAD_S = 0.02


class Instant(NamedTuple):
    """Record of one tick."""

    t_s: float
    q: np.ndarray
    dq: np.ndarray
    status: ServoStatus


class JumpingClock:
    """The twin's clock plus an offset."""

    def __init__(self, clock: TwinClock) -> None:
        self._clock = clock
        self.ahead_s = 0.0

    def now_s(self) -> float:
        return self._clock.now_s() + self.ahead_s

    def sleep_until(self, t_s: float) -> None:
        self._clock.sleep_until(t_s - self.ahead_s)


class WireBench:
    """A connected, claimed arm that executes one trajectory of joint 1 while a fault is injected."""

    def __init__(self, mode: Z1Mode = Z1Mode.TRACKING) -> None:
        self.world = World(SceneConfig())
        self.twin = ControlledWorld(self.world)
        self.twin_clock = TwinClock(self.world)
        self.clock = JumpingClock(self.twin_clock)
        self.link = TwinLink(self.twin, self.twin_clock, self.clock)
        self.twin_clock.call_every_tick(self._record_torque)
        self.arm = Z1Arm(self.clock, Z1ArmConfig(mode=mode), link=self.link)
        self.servo = Servo(self.arm, self.clock, heartbeat_timeout_s=_HEARTBEAT_TIMEOUT_S)
        self.highest_torque = np.zeros(z1.N_JOINTS)
        """(7,) maximum torque of the motors [Nm]."""
        self.highest_commanded = np.zeros(z1.N_JOINTS)
        """(7,) maximum torque commanded in low-level mode [Nm]."""
        self.instants: list[Instant] = []
        self.servo.connect()
        self.servo.claim("test")

    def play(self, inject_fault: Callable[[], None]) -> None:
        """Execute 0.8 rad of joint 1, inject a fault during the motion, and continue until the end."""
        self._stream()
        for i in range(round(_MAX_S / PERIOD_S)):
            if i % _BEAT_EVERY == 0 and self.servo.status().owner:
                self.servo.heartbeat()
            if i == round(FAULT_AT_S / PERIOD_S):
                self.fault_s = self.world.time_s
                inject_fault()
            self.servo.tick()
            self._record_commanded()
            self.clock.sleep_until(self.clock.now_s() + PERIOD_S)
            q, dq, _ = self.world.read_arm()
            self.instants.append(Instant(self.world.time_s, q, dq, self.servo.status()))

    @property
    def after(self) -> list[Instant]:
        """Instants since the fault."""
        return [instant for instant in self.instants if instant.t_s > self.fault_s]

    @property
    def status(self) -> ServoStatus:
        """The last one."""
        return self.instants[-1].status

    def report(self, table: FaultsTable, fault: str, reads: object = None) -> None:
        """Add the outcome to `table`."""
        first, status = self.after[0], self.status
        lag = max(np.abs(i.q - i.status.q_command)[: z1.N_ARM].max() for i in self.after)
        finished = f"continues to the end, at most {1e3 * lag:.0f} mrad behind its command"
        braked = describe(status, self.after[-1].q - first.q)
        noticed = next((i.t_s for i in self.after if i.status.mode is not ServoMode.TRACKING), None)
        moving = [i.t_s for i in self.after if np.abs(i.dq[: z1.N_ARM]).max() > _MOVING_RAD_S]
        table.add(
            fault,
            arm=finished if status.finished else braked,
            noticed_s=None if status.finished or noticed is None else noticed - self.fault_s,
            rest_s=None if status.finished or not moving else moving[-1] - self.fault_s,
            reads=status.reason if reads is None else reads,
        )

    def assert_safe(self) -> None:
        """Assert that positions and torques stayed within their limits."""
        q = np.array([instant.q for instant in self.instants])
        assert (q >= z1.Q_MIN - _TOUCH_RAD).all()
        assert (q <= z1.Q_MAX + _TOUCH_RAD).all()
        assert (self.highest_torque <= z1.TAU_MAX + 1e-6).all()
        assert (self.highest_commanded <= np.append(z1.TAU_MAX[:6], self.arm.limits.grip_torque_nm) + 1e-3).all()

    def _record_commanded(self) -> None:
        """Record the torque of the driver's newest command at its newest measurement."""
        if self.arm.mode is Z1Mode.LOW_LEVEL:
            joints = self.arm._client.command.joints
            command = JointCommands(**{name: joints[name].astype(float) for name in ("q", "dq", "tau", "kp", "kd")})
            torque = np.abs(motor_torques(command, self.arm.newest.joints))
            self.highest_commanded = np.maximum(self.highest_commanded, torque)

    def _record_torque(self) -> None:
        self.highest_torque = np.maximum(self.highest_torque, np.abs(self.world.read_arm()[2]))

    def _stream(self) -> None:
        t_s = np.linspace(0.0, MOVE_S, round(MOVE_S / 0.02) + 1)
        u = t_s / MOVE_S
        step = np.eye(z1.N_JOINTS)[0] * 0.8
        q = self.servo.status().q_command + (10 * u**3 - 15 * u**4 + 6 * u**5)[:, None] * step
        dq = (30 * u**2 - 60 * u**3 + 30 * u**4)[:, None] / MOVE_S * step
        self.servo.stream(TrajectoryChunk(trajectory_id=1, t_s=t_s, q=q, dq=dq, final=True))
