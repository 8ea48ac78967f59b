"""Behaviours of the vendor's controller, one for each kind of state: a command from the client in, motor commands out.

Each was measured at the motor board's end of the vendor's controller.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from hal.base import z1
from hal.base.transforms import make_pose
from hal.base.z1_dynamics import FeedForward
from hal.base.z1_kinematics import PivotKinematics
from hal.z1_protocol.controller import KD_JOINTCTRL, KD_PASSIVE, KP_JOINTCTRL, Command
from hal.z1_protocol.records import JointCommands
from sim_twin.controller.motion_planner import TEACH_PERIOD_S, Motion

TRACKING_SPEED = np.pi
"""Maximum speed of a joint towards its target while tracking joints [rad/s]."""
TWIST_JOINT_SPEED = 1.5
"""Maximum speed of a joint while tracking a twist [rad/s]; the whole motion is slowed down to it."""
TRACKED_GRIPPER_RAD = (-1.57, 0.0)
"""Limits of the tracked gripper [rad]; the joints of the arm have none."""
MAX_TEACHING_S = 300.0
"""Maximum length of a recording [s], which bounds its memory."""

_N_COMPENSATED = 3  # the gravity torque of joint4 to joint6 is 0
# Joint4's gain is 25 in JOINTCTRL, TEACHREPEAT and the moves to poses, and 20 in the other states with stiffness.
KP_HOLDING = KP_JOINTCTRL + np.array([0.0, 0.0, 0.0, 5.0, 0.0, 0.0, 0.0])
KP_HOLDING.setflags(write=False)
# Maximum change of a joint in one step of a tracked twist [rad]: a larger one jumps to another branch.
_MAX_CHANGE_RAD = 0.2
_MAX_TWIST = 100.0
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
    """Position servos of the controller, and the torque that carries the arm's weight."""

    def __init__(self) -> None:
        self._feed_forward = FeedForward()

    def command(self, q: np.ndarray, dq: np.ndarray, q_measured: np.ndarray, kp: np.ndarray) -> JointCommands:
        """Return the command that holds `q` (7,) [rad] at `dq` (7,) [rad/s] with gains `kp` (7,)."""
        tau = self.gravity(q_measured)
        tau[_N_COMPENSATED:] = 0.0
        return JointCommands(q=q, dq=dq, tau=tau, kp=kp, kd=KD_JOINTCTRL)

    def gravity(self, q: np.ndarray) -> np.ndarray:
        """Return the weight's torques (7,) [Nm] at `q` (7,) [rad]."""
        return self._feed_forward.torque(q, _REST).copy()


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
    """JOINTCTRL: holds its reference, or leads it to the client's target at a limited speed.

    The target has no position limit. A reference that has passed a joint's limit jumps to a target beyond it.
    """

    done = False

    def __init__(self, q: np.ndarray, servos: Servos) -> None:
        self._q, self._servos = q, servos

    def step(self, command: Command, q: np.ndarray, dt_s: float) -> JointCommands:
        dq = _REST
        if command.track:
            desired, reach, dq = command.joints(), TRACKING_SPEED * dt_s, command.joints().dq
            target = np.append(desired.q[: z1.N_ARM], np.clip(desired.q[z1.N_ARM], *TRACKED_GRIPPER_RAD))
            led = self._q + np.clip(target - self._q, -reach, reach)
            self._q = np.where(_is_outside(self._q) & _is_outside(target), target, led)
        return self._servos.command(self._q, dq, q, KP_HOLDING)


class TwistTracking:
    """CARTESIAN: holds its reference, or moves the pivot with the client's twist (ω then v, in the pivot's frame)."""

    done = False

    def __init__(self, q: np.ndarray, servos: Servos, kinematics: PivotKinematics) -> None:
        self._q, self._servos, self._kinematics = q, servos, kinematics
        self._blocked: Command | None = None

    def step(self, command: Command, q: np.ndarray, dt_s: float) -> JointCommands:
        dq = np.zeros(z1.N_JOINTS)
        if command.track:
            move = command.trajectory()
            # Finding that no pose is in reach takes several steps: once for a command is enough
            if command is not self._blocked:
                dq[: z1.N_ARM] = self._joint_speed(move.poses[0], dt_s)
                self._blocked = command if move.poses[0].any() and not dq.any() else None
            jaw, reach = np.clip(move.gripper_rad, *TRACKED_GRIPPER_RAD), TRACKING_SPEED * dt_s
            self._q = self._q + dq * dt_s
            self._q[z1.N_ARM] += np.clip(jaw - self._q[z1.N_ARM], -reach, reach)
        return self._servos.command(self._q, dq, q, KP_JOINTCTRL)

    def _joint_speed(self, twist: np.ndarray, dt_s: float) -> np.ndarray:
        """Return the arm's joint speeds (6,) [rad/s] for a twist; none when its next pose is out of reach."""
        last = self._q[: z1.N_ARM]
        T = self._kinematics.forward(last)
        # Far beyond any arm's speed, so that only garbage is limited
        step = dt_s * np.clip(twist, -_MAX_TWIST, _MAX_TWIST)
        turned = T[:3, :3] @ Rotation.from_rotvec(step[:3]).as_matrix()
        goal = make_pose(turned, T[:3, 3] + T[:3, :3] @ step[3:])
        q = self._kinematics.inverse(goal, last, _MAX_CHANGE_RAD)
        if q is None:
            return np.zeros(z1.N_ARM)
        speed = (q - last) / dt_s
        return speed / max(1.0, float(np.abs(speed).max()) / TWIST_JOINT_SPEED)


class Following:
    """Moves: follows paths, one after the other; without any it has ended."""

    def __init__(self, motion: Motion, q: np.ndarray, servos: Servos, kp: np.ndarray) -> None:
        self._motion, self._q, self._servos, self._kp = motion, q, servos, kp
        self._next, self._time_s = 0, 0.0
        self.done = not motion.paths

    def step(self, command: Command, q: np.ndarray, dt_s: float) -> JointCommands:
        dq = _REST
        if not self.done:
            self._time_s += dt_s
            path = self._motion.paths[self._next]
            self._q, dq = path.sample(self._time_s)
            if self._time_s >= path.duration_s:
                # The rest of this step belongs to the next path
                self._time_s -= path.duration_s
                self._advance()
        return self._servos.command(self._q, dq, q, self._kp)

    def _advance(self) -> None:
        self._next += 1
        if self._next == len(self._motion.paths):
            if self._motion.repeat_from is None:
                self.done = True
            else:
                self._next = self._motion.repeat_from


class Teaching:
    """TEACH: carries the weight of all joints, and records the motion."""

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
        return JointCommands(q=q, tau=self._servos.gravity(q))


def _is_outside(q: np.ndarray) -> np.ndarray:
    return (q < z1.Q_MIN) | (q > z1.Q_MAX)
