"""Behaviours of the vendor's controller, one for each kind of state: a command from the client in, motor commands out.

Each was measured at the motor board's end of the vendor's controller.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from hal.base import z1
from hal.base.z1_dynamics import FeedForward
from hal.z1_protocol.controller import KD_JOINTCTRL, KD_PASSIVE, KP_JOINTCTRL, Command
from hal.z1_protocol.records import JointCommands
from sim_twin.controller.paths import JointPath

TRACKING_SPEED = np.pi
"""Maximum speed of a joint towards its target while tracking [rad/s]."""
TEACH_PERIOD_S = 0.02
"""Period of the points of a recording [s]; the vendor's was not measured."""
MAX_TEACHING_S = 300.0
"""Maximum length of a recording [s], which bounds its memory."""

_N_COMPENSATED = 3  # the gravity torque of joint4 to joint6 is 0
_REST = np.zeros(z1.N_JOINTS)
_REST.setflags(write=False)


class Behaviour(Protocol):
    """The controller's conduct in one state."""

    done: bool
    """Whether it has ended by itself."""

    def step(self, command: Command, q: np.ndarray, dt_s: float) -> JointCommands:
        """Return the motors' commands (7,) for the next `dt_s` [s].

        Args:
            command: the client's newest command.
            q: (7,) measured joints [rad].
            dt_s: time since the last step [s].

        Raises:
            ProtocolError: the command's body does not fit the state; nothing has changed.
        """
        ...


class Servos:
    """Position servos of the controller: its gains, and the torque that carries the arm's weight."""

    def __init__(self) -> None:
        self._feed_forward = FeedForward()

    def command(self, q: np.ndarray, dq: np.ndarray, q_measured: np.ndarray) -> JointCommands:
        """Return the command that holds `q` (7,) [rad] at `dq` (7,) [rad/s]."""
        return JointCommands(q=q, dq=dq, tau=self.gravity(q_measured), kp=KP_JOINTCTRL, kd=KD_JOINTCTRL)

    def gravity(self, q: np.ndarray) -> np.ndarray:
        """Return the weight's torques (7,) [Nm] at `q` (7,) [rad], of joint1 to joint3 alone."""
        torque = self._feed_forward.torque(q, _REST).copy()
        torque[_N_COMPENSATED:] = 0.0
        return torque


class Damping:
    """PASSIVE, and CALIBRATION, which is `done` at once: damped, without stiffness."""

    def __init__(self, *, done: bool = False) -> None:
        self.done = done

    def step(self, command: Command, q: np.ndarray, dt_s: float) -> JointCommands:
        return JointCommands(q=q, kd=KD_PASSIVE)


class Forwarding:
    """LOWCMD: each command's body is obeyed, that of a state request included."""

    done = False

    def step(self, command: Command, q: np.ndarray, dt_s: float) -> JointCommands:
        desired = command.joints()
        # 9 rad and 50 rad/s were limited, a torque of 700 Nm was not
        return replace(desired, q=np.clip(desired.q, z1.Q_MIN, z1.Q_MAX), dq=np.clip(desired.dq, -z1.DQ_MAX, z1.DQ_MAX))


class Tracking:
    """JOINTCTRL: holds its reference, or leads it to the client's target at a limited speed."""

    done = False

    def __init__(self, q: np.ndarray, servos: Servos) -> None:
        self._q, self._servos = q, servos

    def step(self, command: Command, q: np.ndarray, dt_s: float) -> JointCommands:
        dq = _REST
        if command.track:
            desired, reach = command.joints(), TRACKING_SPEED * dt_s
            self._q = self._q + np.clip(desired.q - self._q, -reach, reach)
            dq = np.clip(desired.dq, -TRACKING_SPEED, TRACKING_SPEED)
        return self._servos.command(self._q, dq, q)


class Following:
    """Moves: follows paths, one after the other; without any it has ended."""

    def __init__(self, paths: list[JointPath], q: np.ndarray, servos: Servos) -> None:
        self._paths, self._q, self._servos = paths, q, servos
        self._time_s = 0.0
        self.done = not paths

    def step(self, command: Command, q: np.ndarray, dt_s: float) -> JointCommands:
        dq = _REST
        if self._paths:
            self._time_s += dt_s
            path = self._paths[0]
            self._q, dq = path.sample(self._time_s)
            if self._time_s >= path.duration_s:
                # The rest of this step belongs to the next path
                self._time_s -= path.duration_s
                del self._paths[0]
                self.done = not self._paths
        return self._servos.command(self._q, dq, q)


class Teaching:
    """TEACH: carries the arm's weight and records its motion."""

    done = False

    def __init__(self, servos: Servos) -> None:
        self._servos = servos
        self._points: list[np.ndarray] = []
        self._time_s = 0.0

    @property
    def recording(self) -> np.ndarray | None:
        """Recorded motion (N, 7) [rad], one row every `TEACH_PERIOD_S`; None when it is too short for a path."""
        return np.array(self._points) if len(self._points) > 1 else None

    def step(self, command: Command, q: np.ndarray, dt_s: float) -> JointCommands:
        self._time_s += dt_s
        if len(self._points) * TEACH_PERIOD_S <= min(self._time_s, MAX_TEACHING_S):
            self._points.append(q)
        return JointCommands(q=q, kd=KD_PASSIVE, tau=self._servos.gravity(q))
