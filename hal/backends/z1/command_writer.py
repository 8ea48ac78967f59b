"""Commands for the vendor's controller: setpoints in, commands within all limits out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hal.backends.z1.client import Z1Client
from hal.backends.z1.config import Z1Mode
from hal.backends.z1.torque_limits import limit_commands
from hal.base import z1
from hal.base.errors import HalTimeoutError
from hal.base.messages import ArmSetpoint
from hal.servo.limits import ServoLimits, clip_setpoint
from hal.z1_protocol.controller import KD_JOINTCTRL, KD_LOWCMD, KP_JOINTCTRL, KP_LOWCMD
from hal.z1_protocol.records import JointCommands
from hal.z1_protocol.states import Fsm

if TYPE_CHECKING:
    from hal.base.z1_dynamics import FeedForward

_MAX_SKIPPED = 5  # periods of motion in one command; normally one, or two where the controller is the slower one
_MAX_LEAD_RAD = 0.35  # above the servo's following-error limit, so that the servo reports a blocked arm first
# The controller repeats its last measurement while its motor board is silent (measured on the vendor's controller).
_STALE_S = 0.1
_STALE_RAD = 0.05
_STILL_RAD = 0.001  # a command that moved less is at rest, where measurements may repeat
_GRIPPER = z1.N_ARM
_SAME_JAW_RAD = 0.01
_REST = np.zeros(z1.N_JOINTS)
_REST.setflags(write=False)


class CommandWriter:
    """Limits every command and writes it into the client's buffer; it expects the driver's lock.

    Args:
        client: owner of the command buffer.
        limits: limits of every command.
    """

    def __init__(self, client: Z1Client, limits: ServoLimits) -> None:
        self._client = client
        self._limits = limits
        self._feed_forward: FeedForward | None = None
        self.mode = Z1Mode.OBSERVE
        """Format of the commands written."""
        self.grip_nm: float | None = None
        """Torque of the gripper [Nm]; None = position control."""
        self.q_sent = self._still_q = self._q_wire = _REST
        """(7,) last position commanded [rad]."""
        self._still_s = 0.0
        self._held_jaw: tuple[float, float] | None = None

    def prepare(self, mode: Z1Mode) -> None:
        """Load what a mode needs, which takes a second: never while the arm sinks in PASSIVE."""
        if mode is Z1Mode.LOW_LEVEL and self._feed_forward is None:
            from hal.base.z1_dynamics import FeedForward  # pinocchio is loaded only where torques are needed

            self._feed_forward = FeedForward()

    def start_mode(self, mode: Z1Mode) -> None:
        """Start a mode with the command equal to the measurement; the jaw keeps its grip."""
        self.prepare(mode)
        self.mode = mode
        measured = self._client.newest.joints.q
        # While tracking, the jaw's torque is that of a target ahead of it; LOWCMD keeps it by `grip_nm`.
        q = np.append(measured[:_GRIPPER], self._client.posture().q[_GRIPPER])
        self.q_sent = self._still_q = self._q_wire = q if mode is Z1Mode.TRACKING else measured
        # A client that starts from the measurement, as after a change of drivers, must not let go of an object.
        self._held_jaw = (measured[_GRIPPER], q[_GRIPPER]) if mode is Z1Mode.TRACKING else None
        self._still_s = self._client.newest_s

    def write_hold(self) -> None:
        """Write the last position once more, at rest."""
        if self.mode is not Z1Mode.OBSERVE:
            self._write(self.q_sent, _REST)

    def write_setpoint(self, setpoint: ArmSetpoint) -> ArmSetpoint:
        """Write the command nearest to `setpoint` within all limits, and return it.

        In this order: `hal.servo.limits.clip_setpoint` (joint limits, grip torque, maximum step of one period), the
        lead over the measurement, and in low-level mode the torques.
        """
        joints = self._client.newest.joints
        measured, q, dq = joints.q, setpoint.q, setpoint.dq
        if self.grip_nm is not None:
            q, dq = q.copy(), dq.copy()
            q[_GRIPPER], dq[_GRIPPER] = measured[_GRIPPER] + self.grip_nm / z1.KP[_GRIPPER], 0.0
        elif self._held_jaw is not None:
            found, held = self._held_jaw
            # By its speed too: a servo steps from the position that was applied, which would never get away.
            if dq[_GRIPPER] == 0.0 and abs(q[_GRIPPER] - found) < _SAME_JAW_RAD:
                q = np.append(q[:_GRIPPER], held)
            else:
                self._held_jaw = None
        allowed = clip_setpoint(self._limits, q, dq, q_last=self.q_sent, q_measured=measured, dq_measured=joints.dq)
        q = np.minimum(np.maximum(allowed.q, measured - _MAX_LEAD_RAD), measured + _MAX_LEAD_RAD)
        # A controller that has no room for commands must not find a leap when it has again.
        leap = _MAX_SKIPPED * self._limits.dq_max * z1.CONTROL_PERIOD_S
        q = np.minimum(np.maximum(q, self._q_wire - leap), self._q_wire + leap)
        q, dq = self._write(q, np.where(q == allowed.q, allowed.dq, 0.0))
        self.q_sent = q
        return ArmSetpoint(q=q, dq=dq)

    def write_motor_commands(self, desired: JointCommands) -> JointCommands:
        """Write motor commands within all limits, in low-level mode, and return them.

        Raises:
            InvalidMessageError: values that are not finite.
        """
        allowed = self._limit(desired)
        self._write_motors(allowed)
        self.q_sent = allowed.q
        return allowed

    def make_entry_command(self) -> JointCommands:
        """Start the low-level mode and return its first command: the measurement, at rest."""
        self.start_mode(Z1Mode.LOW_LEVEL)
        return self._compensate(self._client.newest.joints.q, _REST)

    def send(self) -> None:
        """Send the command written last, if the controller has room for it."""
        if self._client.send():
            self._q_wire = self.q_sent

    def check_freshness(self) -> None:
        """Check that the measurements change while the arm is commanded to move.

        Raises:
            HalTimeoutError: the controller repeats one measurement.
        """
        client = self._client
        commanded = np.abs(self.q_sent - self._still_q)[:_GRIPPER].max()
        if commanded < _STILL_RAD or client.changed_s > self._still_s:
            self._still_q, self._still_s = self.q_sent, client.newest_s
            return
        silent_s = client.newest_s - self._still_s
        if silent_s > _STALE_S and commanded > _STALE_RAD:
            raise HalTimeoutError(
                f"Z1: the controller has repeated one measurement for {silent_s:.2f} s during a commanded motion of "
                f"{commanded:.2f} rad (allowed {_STALE_S} s or {_STALE_RAD} rad): the motor board is silent or the arm "
                f"is blocked. Check its power, its network cable, and its contacts.",
                code="stale_measurement",
            )

    # --- Inside -------------------------------------------------------------------------------------------------

    def _write(self, q: np.ndarray, dq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Write a command; return the part of it within the torque limits."""
        if self.mode is Z1Mode.LOW_LEVEL:
            allowed = self._compensate(q, dq)
            self._write_motors(allowed)
            return allowed.q, allowed.dq
        client = self._client
        # While tracking, the controller reads positions and speeds alone (measured). The rest is what keeps the arm
        # where it is if it has gone to LOWCMD meanwhile; in CARTESIAN a target of joints would be read as a twist.
        tau = np.minimum(np.maximum(client.newest.joints.tau, -z1.TAU_MAX), z1.TAU_MAX)
        tau[_GRIPPER] = 0.0
        commands = JointCommands(q=q, dq=dq, tau=tau, kp=KP_JOINTCTRL, kd=KD_JOINTCTRL)
        client.write_joints(commands, track=client.newest.state is Fsm.JOINTCTRL)
        return q, dq

    def _write_motors(self, commands: JointCommands) -> None:
        self._client.write_joints(commands, track=False)

    def _compensate(self, q: np.ndarray, dq: np.ndarray) -> JointCommands:
        """Return the motors' commands for a setpoint: default gains, gravity and friction compensated."""
        assert self._feed_forward is not None
        kp, kd, tau = KP_LOWCMD, KD_LOWCMD, self._feed_forward.torque(q, dq)
        if self.grip_nm is not None:
            kp, kd = kp.copy(), kd.copy()
            kp[_GRIPPER], kd[_GRIPPER] = 0.0, KD_JOINTCTRL[_GRIPPER]
            tau[_GRIPPER] += self.grip_nm
        return self._limit(JointCommands(q=q, dq=dq, tau=tau, kp=kp, kd=kd))

    def _limit(self, desired: JointCommands) -> JointCommands:
        return limit_commands(desired, self._client.newest.joints, self._limits)
