"""Mock arm: it follows its setpoints with a lag, and fails on request."""

from __future__ import annotations

from typing import Any

import numpy as np

from hal.base.clock import Clock, WallClock
from hal.base.errors import CommandRejectedError, HalTimeoutError, NotConnectedError
from hal.base.messages import ArmSetpoint, ArmState
from hal.base.z1 import KP, N_JOINTS, Q_HOME, Q_MAX, Q_MIN, TAU_MAX
from hal.rig import Rig

STALE_S = 0.1
"""Maximum age of a measurement [s]."""


class MockArm:
    """Six joints and a gripper with a first-order response, for tests and trials without a robot.

    Torque is the lag times the Z1's stiffness, as in its position servo.

    Args:
        clock: source of time; None = wall clock.
        q: (7,) pose before the first setpoint [rad]; None = home with the jaws closed.
        time_constant_s: time constant of the response [s]; 0 = immediate.
    """

    def __init__(
        self, clock: Clock | None = None, *, q: np.ndarray | None = None, time_constant_s: float = 0.01
    ) -> None:
        self.clock = clock or WallClock()
        self._time_constant_s = time_constant_s
        self._q = np.append(Q_HOME, 0.0) if q is None else np.array(q, dtype=float)
        self._dq = np.zeros(N_JOINTS)
        self._target = self._q.copy()
        self._moved_s = 0.0
        self._connected = False
        self._faults: tuple[str, ...] = ()
        self._frozen: ArmState | None = None
        self._blocked_q: np.ndarray | None = None
        self.drop_commands = False
        """Setpoints are lost while this is set."""
        self.reject_commands = False
        """Setpoints are rejected while this is set."""
        self.offset = np.zeros(N_JOINTS)
        """(7,) constant following error: the arm settles at setpoint + offset [rad]."""

    def connect(self) -> None:
        self._connected = True
        self._moved_s = self.clock.now_s()

    def disconnect(self) -> None:
        self._connected = False

    def read_state(self) -> ArmState:
        self._check_connected()
        now_s = self.clock.now_s()
        self._move(now_s)
        if self._frozen is not None:
            age_s = now_s - self._frozen.stamp_s
            if age_s > STALE_S:
                raise HalTimeoutError(
                    f"mock arm: the newest measurement is {age_s:.3f} s old; allowed is {STALE_S} s. Call thaw().",
                    code="stale_state",
                )
            return self._frozen
        tau = np.clip(KP * (self._target - self._q), -TAU_MAX, TAU_MAX)
        return ArmState(stamp_s=self._moved_s, q=self._q, dq=self._dq, tau=tau, faults=self._faults)

    def send(self, setpoint: ArmSetpoint) -> ArmSetpoint:
        self._check_connected()
        if self.reject_commands:
            raise CommandRejectedError("mock arm: commands are rejected; unset `reject_commands`.")
        self._move(self.clock.now_s())
        q = np.clip(setpoint.q, Q_MIN, Q_MAX)
        if not self.drop_commands:
            self._target = q
        return ArmSetpoint(q=q, dq=np.where(q == setpoint.q, setpoint.dq, 0.0))

    def stop(self) -> None:
        if self._connected:
            self._move(self.clock.now_s())
            self._target = self._q.copy()

    # --- Fault injection ------------------------------------------------------------------------------------

    def inject_fault(self, *faults: str) -> None:
        """Report these faults from now on, for instance "overheat joint 2"; none clears them."""
        self._faults = faults

    def freeze(self) -> None:
        """Deliver no new measurement from now on; the arm itself moves on."""
        self._frozen = self.read_state()

    def thaw(self) -> None:
        """Deliver new measurements again, after `freeze`."""
        self._frozen = None

    def block(self, joint: int | None) -> None:
        """Block this joint (0…6) against all commands; None releases it."""
        self._blocked_q = None
        if joint is not None:
            self._blocked_q = np.full(N_JOINTS, np.nan)
            self._blocked_q[joint] = self._q[joint]

    def _check_connected(self) -> None:
        if not self._connected:
            raise NotConnectedError("the mock arm")

    def _move(self, now_s: float) -> None:
        dt_s = now_s - self._moved_s
        if dt_s <= 0:
            return
        response = 1.0 if self._time_constant_s <= 0 else -np.expm1(-dt_s / self._time_constant_s)
        q = self._q + response * (self._target + self.offset - self._q)
        if self._blocked_q is not None:
            q = np.where(np.isnan(self._blocked_q), q, self._blocked_q)
        self._dq = (q - self._q) / dt_s
        self._q, self._moved_s = q, now_s


def make_rig(**_: Any) -> Rig:
    """Return a rig of a mock arm and the built-in recording, on the wall clock; other options are ignored."""
    from hal.backends.replay_camera import ReplayCamera

    clock = WallClock()
    return Rig(arm=MockArm(clock), camera=ReplayCamera(clock=clock), clock=clock)
