"""Mode machine of the real Z1: which mode the arm is in, and the transitions between modes without a jerk."""

from __future__ import annotations

import numpy as np

from hal.backends.z1.client import Z1Client
from hal.backends.z1.command_writer import CommandWriter
from hal.backends.z1.config import Z1Mode
from hal.backends.z1.requests import StateRequester
from hal.base import z1
from hal.base.errors import CommandRejectedError, HalError, NotConnectedError
from hal.z1_protocol.states import MOVES, Fsm

_STATE_OF_MODE = {
    Z1Mode.OBSERVE: None,
    Z1Mode.TRACKING: Fsm.JOINTCTRL,
    Z1Mode.LOW_LEVEL: Fsm.LOWCMD,
}
# After a mode change the arm must hold still for a while: a wrong zero or an unmodelled load shows within 0.1 s.
_SETTLE_S = 0.1
_SETTLE_RAD = 0.05
# LOWCMD is entered through PASSIVE, where a moving arm would go on moving.
_REST_SPEED = 0.05
_REST_WAIT_S = 0.2
# Time for each step through PASSIVE once it was seen [s], ten cycles: the arm sinks meanwhile.
_ENTRY_S = 0.02
# Ten answer periods a try, and five tries in case single datagrams are lost.
_REFRESH_WAIT_S = 0.02
_REFRESH_TRIES = 5


class ModeMachine:
    """Mode of one arm, and whether a motion of the controller's own suspends our commands.

    It has no lock of its own: `Z1Arm` and `ControllerMotions` hold the driver's lock around every call.

    Args:
        client: connection to the controller.
        requests: requests of its states.
        commands: writer of the commands.
        move_timeout_s: timeout of a controller motion that is under way when a mode is entered [s].
    """

    def __init__(
        self, client: Z1Client, requests: StateRequester, commands: CommandWriter, move_timeout_s: float
    ) -> None:
        self._client = client
        self._requests = requests
        self._commands = commands
        self._move_timeout_s = move_timeout_s
        self.mode: Z1Mode | None = None
        """Present mode; None when not connected."""
        self.moving = False
        """Whether the controller executes a motion that this driver started."""

    # --- Checks -------------------------------------------------------------------------------------------------

    def require_connection(self) -> Z1Client:
        """Return the client.

        Raises:
            NotConnectedError: not connected.
        """
        if self.mode is None:
            raise NotConnectedError("the Z1")
        return self._client

    def require_command_authority(self) -> Z1Client:
        """Return the client when the arm takes commands.

        Raises:
            NotConnectedError: not connected.
            CommandRejectedError: a controller motion is under way, the arm is only observed, or the controller has
                left the state of the mode.
        """
        client = self.require_connection()
        if self.moving:
            raise CommandRejectedError(
                "Z1: the controller executes a motion of its own; stop it, or wait for its end.",
                code="controller_moving",
            )
        if client.expected is None:
            raise CommandRejectedError("Z1: the arm is only observed; enter another mode first.", code="observe_only")
        if client.has_left:
            raise CommandRejectedError(
                f"Z1: {client.describe_departure(client.newest.state)}, and does not follow. Inspect the arm, then "
                f"connect again.",
                code="controller_left_state",
            )
        return client

    # --- Transitions --------------------------------------------------------------------------------------------

    def start(self, mode: Z1Mode) -> None:
        """Enter the first mode after the client was opened; on failure nothing is connected.

        Raises:
            CommandRejectedError, HalTimeoutError: see `enter`.
        """
        self.mode, self.moving = Z1Mode.OBSERVE, False
        try:
            if self._client.newest.state is Fsm.LOWCMD:  # left there by another client: every datagram drives motors
                self._requests.request(Fsm.JOINTCTRL)
            self.enter(mode)
        except HalError:
            self.mode = None
            raise

    def leave(self) -> None:
        """Leave the arm holding, in JOINTCTRL; nothing is connected afterwards, even on failure.

        Raises:
            HalError: the controller does not answer.
        """
        try:
            if self.mode is Z1Mode.LOW_LEVEL:
                self._requests.request(Fsm.JOINTCTRL)
            elif self.mode is Z1Mode.TRACKING:
                self.stop()
        finally:
            self.mode = None

    def enter(self, mode: Z1Mode) -> None:
        """Enter a mode, in which the arm holds; see `Z1Arm.enter`."""
        client = self.require_connection()
        if client.newest.state in MOVES:
            self._requests.wait_for_state(Fsm.JOINTCTRL, self._move_timeout_s)
        self.moving = False
        self.observe()
        if mode is Z1Mode.LOW_LEVEL:
            self._enter_low_level()
        elif mode is Z1Mode.TRACKING and client.newest.state is not Fsm.JOINTCTRL:
            self._requests.request(Fsm.JOINTCTRL)
        self.mode = mode
        self.resume()
        if mode is not Z1Mode.OBSERVE:
            self._settle()

    def observe(self) -> None:
        """Send no more commands from now on."""
        self.mode = self._commands.mode = Z1Mode.OBSERVE

    def suspend(self) -> None:
        """Suspend our commands while the controller executes a motion of its own."""
        self.moving = True

    def resume(self) -> None:
        """Resume our commands, from where the arm is."""
        mode = self.mode or Z1Mode.OBSERVE
        self.moving = False
        self._client.expected = _STATE_OF_MODE[mode]
        self._commands.start_mode(mode)
        self.hold()

    def stop(self) -> None:
        """Interrupt a controller motion, if any, and hold. Harmless when not connected.

        Raises:
            HalError: the controller does not confirm; holding is requested nevertheless.
        """
        self._client.cancelled = False  # the stop's own requests below must not be cancelled
        if self.mode is None:
            return
        try:
            if self.moving:
                self.moving = False
                try:
                    self._requests.request(Fsm.JOINTCTRL)
                finally:
                    self.resume()
        finally:
            self.hold()

    # --- One period ---------------------------------------------------------------------------------------------

    def hold(self) -> None:
        """Send the last command once more, at rest."""
        if not self.moving:
            self._commands.write_hold()
        self._commands.send()

    def refresh(self) -> None:
        """Exchange datagrams until a new answer arrives, after a pause."""
        self._client.receive()
        for _ in range(_REFRESH_TRIES):
            self.hold()
            if self._client.receive(_REFRESH_WAIT_S):
                return

    # --- Inside -------------------------------------------------------------------------------------------------

    def _enter_low_level(self) -> None:
        client = self._client

        def speed() -> float:
            return float(np.abs(client.newest.joints.dq[: z1.N_ARM]).max())

        if speed() > _REST_SPEED and client.newest.state is Fsm.PASSIVE:
            self._requests.request(Fsm.JOINTCTRL)  # the arm sinks: catch it first
        if speed() > _REST_SPEED and not client.exchange_until(lambda: speed() <= _REST_SPEED, _REST_WAIT_S):
            raise CommandRejectedError(
                f"Z1: the arm moves at {speed():.2f} rad/s; low-level mode is entered at rest (below {_REST_SPEED} "
                f"rad/s). Wait until it rests.",
                code="arm_moving",
            )
        before = client.newest.state
        if before is Fsm.LOWCMD:
            return
        self._commands.prepare(Z1Mode.LOW_LEVEL)
        try:
            self._requests.request(Fsm.PASSIVE, timeout_s=_ENTRY_S)
            self._requests.request(Fsm.LOWCMD, self._commands.make_entry_command(), timeout_s=_ENTRY_S)
        except HalError:
            self._commands.mode = Z1Mode.OBSERVE
            if before is not Fsm.PASSIVE:
                client.cancelled = False  # after a stop, too, the arm must not be left sinking
                self._requests.request(Fsm.JOINTCTRL)
            raise

    def _settle(self) -> None:
        client, held = self._client, self._commands.q_sent
        end_s = client.clock.now_s() + _SETTLE_S
        while client.clock.now_s() < end_s:
            self.hold()
            client.clock.sleep_until(client.clock.now_s() + z1.CONTROL_PERIOD_S)
            client.receive()
        client.check_age()
        deviation = np.abs(client.newest.joints.q - held)[: z1.N_ARM]
        if deviation.max() <= _SETTLE_RAD:
            return
        worst = int(deviation.argmax())
        if client.newest.state is Fsm.LOWCMD:
            self._requests.request(Fsm.JOINTCTRL)
        self.observe()
        client.expected = None
        raise CommandRejectedError(
            f"Z1: {z1.JOINT_NAMES[worst]} moved by {deviation[worst]:.3f} rad while holding (allowed {_SETTLE_RAD}): "
            f"the load exceeds the model, or the joint's zero is off. The controller holds it; inspect the arm.",
            code="arm_not_holding",
        )
