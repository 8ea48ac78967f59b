"""The motors of a simulated arm, as its arm board has them: what they are told, what they measure, what ails them.

The vendor publishes neither how a motor warms up nor what it does when it hears nothing or has a fault: the figures
here are round, and a motor that cannot go on lets go, damped as in the controller's PASSIVE.
"""

from __future__ import annotations

import numpy as np

from hal.base import z1
from hal.z1_protocol.controller import KD_PASSIVE
from hal.z1_protocol.records import KD_SCALE, KP_SCALE, JointCommands, JointStates, MotorError
from sim_twin.controller.fault_injection import AILMENTS
from sim_twin.model.world import World

SILENCE_S = 0.1
"""After so long without a command a motor lets go [s]."""
AMBIENT_C = 30.0
"""Of a motor that rests [°C]."""
HEATING_K = 80.0
"""How much warmer a motor gets in the end at its effort limit; with the square of its torque [K]."""
HEATING_S = 300.0
"""Time constant of that [s]."""
OVERHEAT_C = 95.0
"""A motor as hot as this reports it, and lets go until its error bit is cleared, as by switching off and on [°C]."""

_PERIOD_S = z1.CONTROL_PERIOD_S
_LOOK_TICKS, _HEAT_TICKS = 5, 50
_LETS_GO = np.uint8(MotorError.OVER_CURRENT | MotorError.OVERHEAT)
_MOTORS = np.ones(z1.N_JOINTS)
_MOTORS[1] = 2.0
_REAL = np.arange(2) < _MOTORS[:, None]
_MOTOR_TAU_MAX = (z1.TAU_MAX / _MOTORS)[:, None]
_FIELDS = ("q", "dq", "tau", "kp", "kd")


class Motors:
    """The motors of one world's arm; until their first command they stay where they are parked.

    Args:
        world: whose arm it is; who owns it calls `tick` before each of its steps.
        ailments: a record of `sim_twin.controller.fault_injection.AILMENTS` that others may write into;
            by default one of its own.
    """

    def __init__(self, world: World, ailments: np.ndarray | None = None) -> None:
        self.world = world
        self._ailments = np.zeros((), AILMENTS) if ailments is None else ailments
        self.error: np.ndarray = self._ailments["error"]
        """(7, 2) `MotorError` bits; set them to break a motor."""
        self.link: np.ndarray = self._ailments["link"]
        """(7, 2) `MotorLink`; the same."""
        self.temperature_c = np.full((z1.N_JOINTS, 2), AMBIENT_C)
        """(7, 2) [°C]."""
        self.awake = False
        """Whether a command has come."""
        self._told = JointCommands()
        self._unheard_s = np.zeros(z1.N_JOINTS)
        self._limp = np.zeros(z1.N_JOINTS, dtype=bool)
        self._ticks = 0
        self._measured_s = -_PERIOD_S
        self._measured = JointStates(q=world.read_arm()[0])

    @property
    def silent(self) -> bool:
        """Whether the board is dead: it passes nothing on, and answers nothing; may be set."""
        return bool(self._ailments["silent"])

    @silent.setter
    def silent(self, silent: bool) -> None:
        self._ailments["silent"] = silent

    def obey(self, commands: JointCommands) -> None:
        """Pass commands on, of all seven joints or of the six without the gripper, to the motors that hear them."""
        self.awake = True
        if len(commands.q) == z1.N_JOINTS and not self._limp.any() and not (self.error.any() or self.link.any()):
            self._told, self._unheard_s[:] = commands, 0.0
            self._drive(commands)
            return
        heard = np.any(self._working(errors=False), axis=1)
        heard[len(commands.q) :] = False
        told = {name: getattr(self._told, name).copy() for name in _FIELDS}
        for name, values in told.items():
            values[heard] = getattr(commands, name)[heard[: len(commands.q)]]
        self._told = JointCommands(**told)
        self._unheard_s[heard] = 0.0
        self._act()

    def tick(self) -> None:
        """Let 2 ms pass; to be called before each step of the world."""
        self._ticks += 1
        if self._ticks % _HEAT_TICKS == 0:
            self.warm(_HEAT_TICKS * _PERIOD_S)
        if self.awake:
            self._unheard_s += _PERIOD_S
            if self._ticks % _LOOK_TICKS == 0 and (self._lets_go() != self._limp).any():
                self._act()

    def warm(self, dt_s: float) -> None:
        """Let the motors warm up or cool down for `dt_s` [s] under their present torques."""
        effort = np.abs(self.world.read_arm()[2] / _MOTORS)[:, None] / _MOTOR_TAU_MAX
        end_c = AMBIENT_C + HEATING_K * effort**2
        self.temperature_c += (end_c - self.temperature_c) * -np.expm1(-dt_s / HEATING_S)
        self.error[(self.temperature_c >= OVERHEAT_C) & _REAL] |= np.uint8(MotorError.OVERHEAT)

    def measure(self) -> JointStates:
        """Return what the motors tell; of a joint whose motors are all lost, what it told last."""
        q, dq, tau = self.world.read_arm()
        last, now_s = self._measured, self.world.time_s
        lost = ~self._working(errors=False).any(axis=1)
        q[lost], dq[lost], tau[lost] = last.q[lost], last.dq[lost], last.tau[lost]
        self._measured = JointStates(
            q=q,
            dq=dq,
            ddq=(dq - last.dq) / max(now_s - self._measured_s, _PERIOD_S),
            tau=tau,
            temperature_c=np.clip(np.rint(self.temperature_c), -128, 127).astype(np.int8),
            error=self.error.copy(),
            link=self.link.copy(),
        )
        self._measured_s = now_s
        return self._measured

    def _working(self, *, errors: bool) -> np.ndarray:
        """Return which motors (7, 2) hear commands and, with `errors`, have no fault that stops them."""
        working = _REAL & (self.link == 0)
        return working & ((self.error & _LETS_GO) == 0) if errors else working

    def _lets_go(self) -> np.ndarray:
        """Return which joints (7,) are driven by no motor."""
        return (self._unheard_s > SILENCE_S) | (((self.error & _LETS_GO) != 0) | ~_REAL).all(axis=1)

    def _act(self) -> None:
        limp = self._limp = self._lets_go()
        told = self._told
        share = self._working(errors=True).sum(axis=1) / _MOTORS
        self._drive(
            JointCommands(
                q=told.q,
                dq=np.where(limp, 0.0, told.dq),
                tau=np.where(limp, 0.0, told.tau),
                kp=np.where(limp, 0.0, told.kp),
                kd=np.where(limp, KD_PASSIVE, told.kd),
            ),
            np.where(share > 0.0, share, 1.0) * z1.TAU_MAX,
        )

    def _drive(self, told: JointCommands, tau_max: np.ndarray = z1.TAU_MAX) -> None:
        kp, kd = KP_SCALE * told.kp, KD_SCALE * told.kd
        self.world.set_motors(told.q, told.dq, told.tau, kp, kd, tau_max=tau_max)
