"""How the real Z1 gets from one mode into another without a jerk."""

from __future__ import annotations

import numpy as np

from hal.backends.z1.client import Z1Client
from hal.backends.z1.config import Z1Mode
from hal.backends.z1.session import Z1Session
from hal.base import z1
from hal.base.errors import CommandRejectedError, HalError
from hal.z1_protocol.states import MOVES, Fsm

_SETTLE_S = 0.1
_SETTLE_RAD = 0.05
_REST_SPEED = 0.05
_REST_WAIT_S = 0.2
_ENTRY_S = 0.05


class Z1Modes(Z1Session):
    """Enters modes, and lets the arm go."""

    def enter(self, mode: Z1Mode) -> None:
        """Bring the arm into a mode, where it holds; a moving arm, or one in another's hands, is left alone.

        LOW_LEVEL is entered through PASSIVE, as the controller wants it, with the command equal to the measurement;
        on the way the arm is without stiffness for about two answers (5 ms). When it does not hold there, it is
        given back to JOINTCTRL.

        Raises:
            CommandRejectedError: the controller does not go there, or the arm does not hold still; it is only observed
                then.
            HalTimeoutError: it stopped answering.
        """
        with self._lock:
            client = self._connected()
            if client.newest.state in MOVES:
                client.wait_for(Fsm.JOINTCTRL, self.config.connect_timeout_s)
            self._moving = False
            self._mode = self._commands.mode = Z1Mode.OBSERVE
            if mode is Z1Mode.LOW_LEVEL:
                self._enter_low_level(client)
            elif mode is Z1Mode.TRACKING and client.newest.state is not Fsm.JOINTCTRL:
                client.ask(Fsm.JOINTCTRL)
            self._mode = mode
            self._resume()
            if mode is not Z1Mode.OBSERVE:
                self._settle(client)

    def go_passive(self) -> None:
        """Let the arm sink, damped, and only observe it from now on. Support it, or park it first.

        Raises:
            CommandRejectedError, HalTimeoutError: the controller does not.
        """
        with self._lock:
            self._connected().ask(Fsm.PASSIVE)
            self._mode = self._commands.mode = Z1Mode.OBSERVE

    def _enter_low_level(self, client: Z1Client) -> None:
        def speed() -> float:
            return float(np.abs(client.newest.joints.dq[: z1.N_ARM]).max())

        if speed() > _REST_SPEED and client.newest.state is Fsm.PASSIVE:
            client.ask(Fsm.JOINTCTRL)  # it sinks: catch it first
        if speed() > _REST_SPEED and not client.exchange_until(lambda: speed() <= _REST_SPEED, _REST_WAIT_S):
            raise CommandRejectedError(
                f"the arm moves at {speed():.2f} rad/s; low-level mode is entered at rest (below {_REST_SPEED} rad/s)."
            )
        was = client.newest.state
        if was is Fsm.LOWCMD:
            return
        try:
            client.ask(Fsm.PASSIVE, timeout_s=_ENTRY_S)
            client.ask(Fsm.LOWCMD, self._commands.entry(), timeout_s=_ENTRY_S)
        except HalError:
            self._commands.mode = Z1Mode.OBSERVE
            if was is not Fsm.PASSIVE:
                client.cancelled = False  # a stop, too, wants an arm that does not sink
                client.ask(Fsm.JOINTCTRL)
            raise

    def _settle(self, client: Z1Client) -> None:
        held = self._commands.q_sent
        end_s = self.clock.now_s() + _SETTLE_S
        while self.clock.now_s() < end_s:
            self._hold()
            self.clock.sleep_until(client.sent_s + z1.CONTROL_PERIOD_S)
            client.receive()
        client.check_answers()
        off = np.abs(client.newest.joints.q - held)[: z1.N_ARM]
        if off.max() <= _SETTLE_RAD:
            return
        worst = int(off.argmax())
        if client.newest.state is Fsm.LOWCMD:
            client.ask(Fsm.JOINTCTRL)
        self._mode = self._commands.mode = Z1Mode.OBSERVE
        client.expected = None
        raise CommandRejectedError(
            f"{z1.JOINT_NAMES[worst]} moved by {off[worst]:.3f} rad while it should hold (allowed {_SETTLE_RAD}): it "
            f"is loaded beyond the model, or its zero is off. It was given back to the controller; look at it."
        )
