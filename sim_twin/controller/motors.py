"""Motors of a simulated arm, as its motor board drives them: commands, measurements, temperatures and faults.

The vendor publishes neither the heating of a motor nor its reaction to silence or a fault: the figures here are round,
and a motor that cannot go on releases its joint, damped as in the controller's PASSIVE.
"""

from __future__ import annotations

import numpy as np

from hal.base import z1
from hal.z1_protocol.controller import KD_PASSIVE
from hal.z1_protocol.records import KD_SCALE, KP_SCALE, JointCommands, JointStates, MotorError
from sim_twin.controller.fault_injection import INJECTED_FAULTS
from sim_twin.model.world import World

COMMAND_TIMEOUT_S = 0.1
"""A motor without a command for this long releases its joint [s]."""
AMBIENT_C = 30.0
"""Temperature of a motor at rest [°C]."""
HEATING_K = 80.0
"""Final temperature rise of a motor at its effort limit; it grows with the square of the torque [K]."""
HEATING_S = 300.0
"""Time constant of the temperature [s]."""
OVERHEAT_C = 95.0
"""A motor at this temperature reports overheat, and releases its joint until its error bit is cleared [°C]."""

_PERIOD_S = z1.CONTROL_PERIOD_S
_CHECK_TICKS, _HEAT_TICKS = 5, 50  # every 10 ms and 100 ms: faults and temperatures change slowly
_RELEASING = np.uint8(MotorError.OVER_CURRENT | MotorError.OVERHEAT)
_MOTORS = np.ones(z1.N_JOINTS)
_MOTORS[1] = 2.0  # joint2 has two
_EXISTS = np.arange(2) < _MOTORS[:, None]
_MOTOR_TAU_MAX = (z1.TAU_MAX / _MOTORS)[:, None]
_FIELDS = ("q", "dq", "tau", "kp", "kd")


class Motors:
    """The motors of one world's arm; until their first command they stay parked.

    Args:
        world: world of the arm; its owner calls `tick` before each of its steps.
        injected_faults: a record of `sim_twin.controller.fault_injection.INJECTED_FAULTS`, written from outside;
            by default a new one.
    """

    def __init__(self, world: World, injected_faults: np.ndarray | None = None) -> None:
        self.world = world
        self._faults = np.zeros((), INJECTED_FAULTS) if injected_faults is None else injected_faults
        self.error: np.ndarray = self._faults["error"]
        """(7, 2) `MotorError` bits; writable, to inject a fault."""
        self.link: np.ndarray = self._faults["link"]
        """(7, 2) `MotorLink`; writable, to inject a fault."""
        self.temperature_c = np.full((z1.N_JOINTS, 2), AMBIENT_C)
        """(7, 2) [°C]."""
        self.awake = False
        """Whether a command was received."""
        self._commands = JointCommands()
        self._command_age_s = np.zeros(z1.N_JOINTS)
        self._released = np.zeros(z1.N_JOINTS, dtype=bool)
        self._ticks = 0
        # One period before the world's start, as the first acceleration divides by the time since the last one
        self._measured_s = -_PERIOD_S
        self._measured = JointStates(q=world.read_arm()[0])

    @property
    def silent(self) -> bool:
        """Whether the board forwards nothing and answers nothing; writable, to inject a fault."""
        return bool(self._faults["silent"])

    @silent.setter
    def silent(self, silent: bool) -> None:
        self._faults["silent"] = silent

    def handle_command(self, commands: JointCommands) -> None:
        """Forward commands of all seven joints, or of the six without the gripper, to the connected motors."""
        self.awake = True
        # The usual case, 250 times a second, without the copies below
        if len(commands.q) == z1.N_JOINTS and not self._released.any() and not (self.error.any() or self.link.any()):
            self._commands, self._command_age_s[:] = commands, 0.0
            self._drive(commands)
            return
        connected = np.any(self._working(errors=False), axis=1)
        connected[len(commands.q) :] = False
        merged = {name: getattr(self._commands, name).copy() for name in _FIELDS}
        for name, values in merged.items():
            values[connected] = getattr(commands, name)[connected[: len(commands.q)]]
        self._commands = JointCommands(**merged)
        self._command_age_s[connected] = 0.0
        self._apply()

    def tick(self) -> None:
        """Advance by 2 ms; to be called before each step of the world."""
        self._ticks += 1
        if self._ticks % _HEAT_TICKS == 0:
            self.heat(_HEAT_TICKS * _PERIOD_S)
        if self.awake:
            self._command_age_s += _PERIOD_S
            if self._ticks % _CHECK_TICKS == 0 and (self._find_released() != self._released).any():
                self._apply()

    def heat(self, dt_s: float) -> None:
        """Advance the temperatures by `dt_s` [s] under the present torques."""
        effort = np.abs(self.world.read_arm()[2] / _MOTORS)[:, None] / _MOTOR_TAU_MAX
        end_c = AMBIENT_C + HEATING_K * effort**2
        # The exact solution of the first-order lag; `expm1` keeps the digits of a short step
        self.temperature_c += (end_c - self.temperature_c) * -np.expm1(-dt_s / HEATING_S)
        self.error[(self.temperature_c >= OVERHEAT_C) & _EXISTS] |= np.uint8(MotorError.OVERHEAT)

    def measure(self) -> JointStates:
        """Return the motors' measurement; a joint whose motors are all disconnected repeats its last one."""
        q, dq, tau = self.world.read_arm()
        last, now_s = self._measured, self.world.time_s
        lost = ~self._working(errors=False).any(axis=1)
        q[lost], dq[lost], tau[lost] = last.q[lost], last.dq[lost], last.tau[lost]
        self._measured = JointStates(
            q=q,
            dq=dq,
            ddq=(dq - last.dq) / max(now_s - self._measured_s, _PERIOD_S),
            tau=tau,
            # A motor's record holds the temperature in one signed byte
            temperature_c=np.clip(np.rint(self.temperature_c), -128, 127).astype(np.int8),
            error=self.error.copy(),
            link=self.link.copy(),
        )
        self._measured_s = now_s
        return self._measured

    def _working(self, *, errors: bool) -> np.ndarray:
        """Return which motors (7, 2) are connected and, with `errors`, have no fault that stops them."""
        working = _EXISTS & (self.link == 0)
        return working & ((self.error & _RELEASING) == 0) if errors else working

    def _find_released(self) -> np.ndarray:
        """Return which joints (7,) are driven by no motor."""
        failed = (((self.error & _RELEASING) != 0) | ~_EXISTS).all(axis=1)
        return (self._command_age_s > COMMAND_TIMEOUT_S) | failed

    def _apply(self) -> None:
        released = self._released = self._find_released()
        commands = self._commands
        ratio = self._working(errors=True).sum(axis=1) / _MOTORS  # with one of its motors joint2 has half the torque
        self._drive(
            JointCommands(
                q=commands.q,
                dq=np.where(released, 0.0, commands.dq),
                tau=np.where(released, 0.0, commands.tau),
                kp=np.where(released, 0.0, commands.kp),
                kd=np.where(released, KD_PASSIVE, commands.kd),
            ),
            # A released joint is damped, so its motors keep their limit
            np.where(ratio > 0.0, ratio, 1.0) * z1.TAU_MAX,
        )

    def _drive(self, commands: JointCommands, tau_max: np.ndarray = z1.TAU_MAX) -> None:
        kp, kd = KP_SCALE * commands.kp, KD_SCALE * commands.kd
        self.world.set_motors(commands.q, commands.dq, commands.tau, kp, kd, tau_max=tau_max)
