"""What every part of the real Z1's driver works on: one conversation, one lock, one mode."""

from __future__ import annotations

from threading import RLock

from hal.backends.z1.client import Z1Client
from hal.backends.z1.commands import Z1Commands
from hal.backends.z1.config import Z1ArmConfig, Z1Diagnostics, Z1Mode
from hal.backends.z1.faults import motor_values
from hal.base.clock import Clock, WallClock
from hal.base.errors import CommandRejectedError, NotConnectedError
from hal.servo.limits import ServoLimits
from hal.z1_protocol.controller import ControllerState
from hal.z1_protocol.link import DatagramLink, UdpLink
from hal.z1_protocol.states import Fsm

_IDLE_WAIT_S = 0.02
_IDLE_TRIES = 5
_FSM = {
    Z1Mode.OBSERVE: None,
    Z1Mode.TRACKING: Fsm.JOINTCTRL,
    Z1Mode.LOW_LEVEL: Fsm.LOWCMD,
}


class Z1Session:
    """A Z1's controller as one client sees it, and how the arm is commanded.

    Args:
        clock: by which it lives; None = the wall's.
        config: where the controller is and how to use it.
        limits: what every command is clipped to.
        link: the way to the controller; None = UDP as in `config`.
    """

    def __init__(
        self,
        clock: Clock | None = None,
        config: Z1ArmConfig | None = None,
        *,
        limits: ServoLimits | None = None,
        link: DatagramLink | None = None,
    ) -> None:
        self.clock = clock or WallClock()
        self.config = config or Z1ArmConfig()
        self.limits = limits or ServoLimits()
        if link is None:
            c = self.config
            link = UdpLink((c.host, c.command_port), (c.local_host, c.state_port))
        self._client = Z1Client(link, self.clock)
        self._commands = Z1Commands(self._client, self.limits)
        self._lock = RLock()
        self._mode: Z1Mode | None = None
        self._moving = False

    @property
    def mode(self) -> Z1Mode | None:
        """How the arm is commanded; None when it is not connected."""
        return self._mode

    @property
    def fsm(self) -> Fsm:
        """What the controller was doing when it answered last.

        Raises:
            NotConnectedError: before `connect()`.
        """
        return self._connected().newest.state

    def idle(self) -> None:
        """Take what came and send the last command once more, at rest: what keeps the controller answering."""
        with self._lock:
            self._connected().receive()
            self._hold()

    @property
    def moving(self) -> bool:
        """Whether the controller is making a motion that was begun here."""
        return self._moving

    @property
    def newest(self) -> ControllerState:
        """The newest answer, however old.

        Raises:
            NotConnectedError: before `connect()`.
        """
        return self._connected().newest

    def diagnostics(self) -> Z1Diagnostics:
        """Return how arm and conversation are doing, from the newest answer.

        Raises:
            NotConnectedError: before `connect()`.
        """
        with self._lock:
            client = self._connected()
            now_s = self.clock.now_s()
            return Z1Diagnostics(
                fsm=client.newest.state,
                pose=client.newest.pose,
                temperatures_c=motor_values(client.newest.joints.temperature_c).astype(float),
                faults=client.faults.latched(),
                answer_age_s=now_s - client.newest_s,
                unchanged_s=now_s - client.changed_s,
                counts=client.counts,
                last_refusal=client.last_refusal,
            )

    def clear_faults(self) -> None:
        """Forget the faults seen so far; what is still there is seen again."""
        with self._lock:
            self._client.faults.clear()

    # --- For the parts above ---------------------------------------------------------------------------------------

    def _connected(self) -> Z1Client:
        if self._mode is None:
            raise NotConnectedError("the Z1")
        return self._client

    def _ready(self) -> Z1Client:
        client = self._connected()
        if self._moving:
            raise CommandRejectedError("the controller is making a motion of its own; stop it, or wait for its end.")
        if client.expected is None:
            raise CommandRejectedError("the arm is only observed; enter another mode first.")
        if client.has_left:
            raise CommandRejectedError(
                f"the controller is in {client.newest.state.name} instead of {client.expected.name} and does not "
                f"follow. Somebody changed it, or it was restarted: look at the arm, then connect again."
            )
        return client

    def _ask_again(self, client: Z1Client) -> None:
        """Get an answer of now: nobody has been sending, and what still waits in the socket may be of any age."""
        client.discard()
        for _ in range(_IDLE_TRIES):
            self._hold()
            if client.receive(_IDLE_WAIT_S):
                return

    def _hold(self) -> None:
        """Send once more what was sent last, at rest."""
        if not self._moving:
            self._commands.hold()
        self._client.send()

    def _resume(self) -> None:
        """Take over where the arm is."""
        mode = self._mode or Z1Mode.OBSERVE
        self._moving = False
        self._client.expected = _FSM[mode]
        self._commands.take_over(mode)
        self._hold()
