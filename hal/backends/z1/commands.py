"""What may be told to the vendor's controller next: wishes in, commands within all limits out."""

from __future__ import annotations

import numpy as np

from hal.backends.z1.client import Z1Client
from hal.backends.z1.config import Z1Mode
from hal.backends.z1.torque import FeedForward, limit_commands
from hal.base import z1
from hal.base.errors import HalTimeoutError
from hal.base.messages import ArmSetpoint
from hal.servo.limits import ServoLimits, clip_setpoint
from hal.z1_protocol.controller import KD_JOINTCTRL, KD_LOWCMD, KP_LOWCMD
from hal.z1_protocol.records import JointCommands
from hal.z1_protocol.states import Fsm

_MAX_LEAD_RAD = 0.35  # above the servo's following error, so that the servo is the one to notice and to say so
_STALE_S = 0.1
_STALE_RAD = 0.05
_STILL_RAD = 0.001
_GRIPPER = z1.N_ARM
_REST = np.zeros(z1.N_JOINTS)
_REST.setflags(write=False)


class Z1Commands:
    """Writes into the client's command; nothing is sent here.

    Args:
        client: whose command is written.
        limits: what every command is clipped to.
    """

    def __init__(self, client: Z1Client, limits: ServoLimits) -> None:
        self._client = client
        self._limits = limits
        self._feed_forward: FeedForward | None = None
        self.mode = Z1Mode.OBSERVE
        self.grip_nm: float | None = None
        """Torque of the gripper [Nm]; None = it goes to a position."""
        self.q_sent = self._still_q = _REST
        """(7,) last position commanded [rad]."""
        self._still_s = 0.0

    def take_over(self, mode: Z1Mode) -> None:
        """Start a mode with the command equal to the measurement."""
        self.mode = mode
        self.q_sent = self._still_q = self._client.newest.joints.q
        self._still_s = self._client.newest_s
        if mode is Z1Mode.LOW_LEVEL and self._feed_forward is None:
            self._feed_forward = FeedForward()

    def hold(self) -> None:
        """Command the last position once more, at rest."""
        if self.mode is not Z1Mode.OBSERVE:
            self._write(self.q_sent, _REST)

    def follow(self, setpoint: ArmSetpoint) -> ArmSetpoint:
        """Command what is nearest to `setpoint`; return it.

        In this order: `hal.servo.limits.clip_setpoint` (joint limits, grip torque, one period's step at the
        highest speed),
        the lead over the measurement, and in low-level mode the torques.
        """
        joints = self._client.newest.joints
        measured, q, dq = joints.q, setpoint.q, setpoint.dq
        if self.grip_nm is not None:
            q, dq = q.copy(), dq.copy()
            q[_GRIPPER], dq[_GRIPPER] = measured[_GRIPPER] + self.grip_nm / z1.KP[_GRIPPER], 0.0
        allowed = clip_setpoint(self._limits, q, dq, q_last=self.q_sent, q_measured=measured, dq_measured=joints.dq)
        q = np.minimum(np.maximum(allowed.q, measured - _MAX_LEAD_RAD), measured + _MAX_LEAD_RAD)
        q, dq = self._write(q, np.where(q == allowed.q, allowed.dq, 0.0))
        self.q_sent = q
        return ArmSetpoint(q=q, dq=dq)

    def follow_motors(self, wish: JointCommands) -> JointCommands:
        """Command the motors directly, in low-level mode; return what is left after all limits.

        Raises:
            InvalidMessageError: values that are not finite.
        """
        allowed = self._limited(wish)
        self._write_motors(allowed)
        self.q_sent = allowed.q
        return allowed

    def entry(self) -> JointCommands:
        """Return the first command of the low-level mode: the measurement, at rest."""
        self.take_over(Z1Mode.LOW_LEVEL)
        return self._balanced(self._client.newest.joints.q, _REST)

    def check_measurements(self) -> None:
        """Raise when the arm is told to move and the same measurement comes again and again.

        The controller goes on answering when its arm board does not, with the last that it heard.

        Raises:
            HalTimeoutError: so it is.
        """
        client = self._client
        told = np.abs(self.q_sent - self._still_q)[:_GRIPPER].max()
        if told < _STILL_RAD or client.changed_s > self._still_s:
            self._still_q, self._still_s = self.q_sent, client.newest_s
            return
        silent_s = client.newest_s - self._still_s
        if silent_s > _STALE_S and told > _STALE_RAD:
            raise HalTimeoutError(
                f"the controller has repeated one measurement for {silent_s:.2f} s while the arm was told to move by "
                f"{told:.2f} rad (allowed: {_STALE_S} s or {_STALE_RAD} rad): the arm itself is silent, or "
                f"blocked. Check its power, its network cable, and what it touches."
            )

    # --- Inside -------------------------------------------------------------------------------------------------

    def _write(self, q: np.ndarray, dq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Write a command; return what of it is left after the torque limits."""
        if self.mode is Z1Mode.LOW_LEVEL:
            allowed = self._balanced(q, dq)
            self._write_motors(allowed)
            return allowed.q, allowed.dq
        joints = self._client.command.joints
        joints["q"] = q
        joints["dq"] = dq
        self._client.command.head(Fsm.INVALID, track=True)
        return q, dq

    def _write_motors(self, commands: JointCommands) -> None:
        joints = self._client.command.joints
        for name in ("q", "dq", "tau", "kp", "kd"):
            joints[name] = getattr(commands, name)
        self._client.command.head(Fsm.INVALID, track=False)

    def _balanced(self, q: np.ndarray, dq: np.ndarray) -> JointCommands:
        """Return the motors' commands for a setpoint: usual gains, gravity and friction compensated."""
        assert self._feed_forward is not None
        kp, kd, tau = KP_LOWCMD, KD_LOWCMD, self._feed_forward.torque(q, dq)
        if self.grip_nm is not None:
            kp, kd = kp.copy(), kd.copy()
            kp[_GRIPPER], kd[_GRIPPER] = 0.0, KD_JOINTCTRL[_GRIPPER]
            tau[_GRIPPER] += self.grip_nm
        return self._limited(JointCommands(q=q, dq=dq, tau=tau, kp=kp, kd=kd))

    def _limited(self, wish: JointCommands) -> JointCommands:
        return limit_commands(wish, self._client.newest.joints, self._limits)
