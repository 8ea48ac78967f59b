"""The real Z1: the vendor's controller over UDP, with the limits and the caution that it has not.

That controller has no watchdog (it keeps its last command for ever), no position limit while tracking and no torque
limit in LOWCMD. All three are enforced here, on every command, and never more than one control period of motion is
handed over: whoever dies leaves an arm that holds.
"""

from __future__ import annotations

import logging

from hal.backends.z1.config import Z1Mode
from hal.backends.z1.moves import Z1Moves
from hal.base.errors import CommandRejectedError, HalError
from hal.base.messages import ArmSetpoint, ArmState
from hal.z1_protocol.records import JointCommands
from hal.z1_protocol.states import Fsm

log = logging.getLogger(__name__)

_QUIET_S = 0.005


class Z1Arm(Z1Moves):
    """A Unitree Z1 with its gripper (`hal.base.arm.Arm`); any thread may call anything."""

    # --- Life -------------------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Find the controller and hold the arm where it is, in the configured mode.

        Raises:
            HalTimeoutError: nobody answers.
            LeaseError: another program talks to it already.
            CommandRejectedError: it does not go into the mode; the arm is left as it was found.
        """
        with self._lock:
            if self._mode is not None:
                return
            client = self._client
            client.open(self.config.connect_timeout_s)
            found = client.newest.state
            self._commands.grip_nm = None
            self._mode, self._moving = Z1Mode.OBSERVE, False
            try:
                if found is Fsm.LOWCMD:  # left there by somebody: every datagram commands its motors
                    client.ask(Fsm.JOINTCTRL)
                self.enter(self.config.mode)
            except HalError:
                self._mode = None
                client.close()
                raise
            log.info("Z1: connected to %s, which was in %s", client.link.describe(), found.name)

    def disconnect(self) -> None:
        with self._lock:
            if self._mode is None:
                return
            try:
                if self._mode is Z1Mode.LOW_LEVEL:
                    self._client.ask(Fsm.JOINTCTRL)
                elif self._mode is Z1Mode.TRACKING:
                    self.stop()
            except HalError as error:
                log.warning("Z1: let go of without an answer: %s", error)
            self._mode = None
            self._client.close()

    # --- The contract -----------------------------------------------------------------------------------------------

    def read_state(self) -> ArmState:
        with self._lock:
            client = self._connected()
            if self.clock.now_s() - client.sent_s > _QUIET_S:
                self._ask_again(client)
            client.receive()
            client.check_answers()
            if not self._moving:
                self._commands.check_measurements()
            joints = client.newest.joints
            return ArmState(
                stamp_s=client.newest_s,
                q=joints.q,
                dq=joints.dq,
                tau=joints.tau,
                faults=client.faults.shown(self.clock.now_s()),
            )

    def send(self, setpoint: ArmSetpoint) -> ArmSetpoint:
        with self._lock:
            self._connected().receive()
            client = self._ready()
            applied = self._commands.follow(setpoint)
            client.send()
            return applied

    def send_motors(self, commands: JointCommands) -> JointCommands:
        """Command the seven motors directly, in LOW_LEVEL; return what is left after the limits on position, speed
        and torque (`hal.backends.z1.torque.limit_commands`). Nothing is compensated.

        A torque without stiffness goes on for ever when this process dies: the controller repeats its last command.

        Raises:
            CommandRejectedError: the arm is in another mode, or does not follow.
            InvalidMessageError: values that are not finite.
        """
        with self._lock:
            self._connected().receive()
            client = self._ready()
            if self._mode is not Z1Mode.LOW_LEVEL:
                raise CommandRejectedError(f"the arm is in mode {self._mode}; motors are commanded in low_level.")
            applied = self._commands.follow_motors(commands)
            client.send()
            return applied

    def stop(self) -> None:
        self._client.cancelled = True  # whoever waits inside, with the lock, gives up
        with self._lock:
            self._client.cancelled = False
            if self._mode is None:
                return
            if self._moving:
                self._moving = False
                try:
                    self._client.ask(Fsm.JOINTCTRL)
                except HalError as error:
                    log.error("Z1: a stop was not confirmed: %s", error)
                self._resume()
            self._hold()

    def grip(self, torque_nm: float | None) -> None:
        """Let the gripper push with a torque instead of going to a position, from the next `send` on.

        Args:
            torque_nm: positive closes, negative opens, at most the limits' grip torque [Nm]; None = by position again.

        Raises:
            CommandRejectedError: not a finite number, or more than the limit.
        """
        limit = self.limits.grip_torque_nm
        if torque_nm is not None and not abs(torque_nm) <= limit:
            raise CommandRejectedError(
                f"a grip torque of {torque_nm} Nm was asked; allowed are −{limit} to {limit} Nm."
            )
        with self._lock:
            self._commands.grip_nm = torque_nm
