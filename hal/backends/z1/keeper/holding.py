"""Holding of an arm whose driver is silent or has ended: the controller lets go of it after 2.2 s without a command."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum

import numpy as np

from hal.backends.z1.keeper.page import Page
from hal.backends.z1.keeper.posture import compute_posture
from hal.base import z1
from hal.z1_protocol.controller import ControllerState, decode_command, decode_state, encode_command
from hal.z1_protocol.link import DatagramLink
from hal.z1_protocol.records import JointCommands, ProtocolError
from hal.z1_protocol.states import Fsm

PERIOD_S = 0.05
"""Period of the keeper's commands [s]: 44 of them before the controller would let go."""
SILENCE_S = 0.2
"""Silence of the driver after which the keeper sends in its place [s]."""

_MAX_DATAGRAMS = 1024
_ANSWER_S = 0.02  # ten of the controller's cycles
_GONE_S = 5.0  # a controller that restarts takes longer, and has let go of the arm by then
_LIMP_COUNT = 3  # one answer alone may be older than the last request
_STAYS = (Fsm.JOINTCTRL, Fsm.PASSIVE, Fsm.INVALID, Fsm.CALIBRATION)


class Phase(StrEnum):
    """What the keeper does."""

    STANDBY = "standby"
    """The driver runs; the keeper sends only while it is silent."""
    HOLDING = "holding"
    """The driver has ended; the keeper holds the arm."""
    RELEASING = "releasing"
    """It lets the arm sink, as an operator asked for."""
    ENDED = "ended"
    """Nothing is to be held any more."""


class Keeper:
    """Commands that keep an arm where it is; it has no thread and no clock.

    Args:
        link: open link to the controller, shared with the driver.
        page: page that the driver writes.
        now_s: present time [s].
    """

    def __init__(self, link: DatagramLink, page: Page, now_s: float) -> None:
        self.phase = Phase.STANDBY
        self.reason = ""
        """Reason of the end."""
        self.newest: ControllerState | None = None
        """The newest answer that the keeper has read."""
        self.stepped_in = 0
        """Commands sent in place of a driver that was silent."""
        self._link, self._page = link, page
        self._count = page.count()
        self._active_s = self._answered_s = now_s
        self._sent_s = -np.inf
        self._limp = 0
        self._posture: JointCommands | None = None

    def end_owner(self, now_s: float) -> None:
        """Take over, since the driver has ended."""
        if self.phase is Phase.STANDBY:
            self.phase, self._answered_s, self._sent_s = Phase.HOLDING, now_s, -np.inf

    def release(self) -> None:
        """Let the arm sink, and end once it does."""
        if self.phase is Phase.HOLDING:
            self.phase = Phase.RELEASING

    def step(self, now_s: float) -> None:
        """Send what is due at `now_s` [s]; to be called every `PERIOD_S` or more often."""
        if self.phase is Phase.STANDBY:
            self._stand_by(now_s)
            return
        self._read(now_s)
        if self._limp >= _LIMP_COUNT:
            self._end("the controller is in PASSIVE, where the arm is limp")
        elif now_s - self._answered_s > _GONE_S:
            self._end(f"the controller has not answered for {_GONE_S:.0f} s")
        elif now_s - self._sent_s >= PERIOD_S:
            self._send(now_s)

    def _stand_by(self, now_s: float) -> None:
        count = self._page.count()
        if count != self._count:
            self._count, self._active_s, self._posture = count, now_s, None
        elif now_s - self._active_s >= SILENCE_S and now_s - self._sent_s >= PERIOD_S:
            self._read(now_s)  # what the driver has not read by now is outdated for it
            if self._posture is None and not _is_posture(command := self._last_command()) and command is not None:
                # The arm may move under that torque: the posture must be that of an answer of this moment.
                self._link.send(encode_command(Fsm.INVALID, command))
                self._read(now_s, _ANSWER_S)
            self._send(now_s)
            self.stepped_in += 1

    def _read(self, now_s: float, timeout_s: float = 0.0) -> None:
        for _ in range(_MAX_DATAGRAMS):
            data = self._link.receive(timeout_s)
            timeout_s = 0.0
            if data is None:
                return
            try:
                self.newest = decode_state(data)
            except ProtocolError:
                continue
            self._answered_s = now_s
            limp = self.newest.state is Fsm.PASSIVE
            self._limp = self._limp + 1 if limp else 0

    def _send(self, now_s: float) -> None:
        self._sent_s = now_s
        state, command = self.newest, self._last_command()
        requested = Fsm.INVALID
        if self.phase is Phase.RELEASING:
            requested = Fsm.PASSIVE
        elif self.phase is Phase.HOLDING and state is not None and state.state not in _STAYS:
            requested = Fsm.JOINTCTRL  # out of a motion, a teaching, or motor commands that are not renewed
        # A torque without stiffness is not repeated for a driver that cannot end it.
        if state is not None and (requested is not Fsm.INVALID or not _is_posture(command)):
            if self._posture is None or requested is not Fsm.INVALID:
                # Once: a posture that followed the measurement would creep with every load.
                q, kp = (command.q, command.kp) if command is not None else (None, None)
                self._posture = compute_posture(state.joints, q, kp)
            self._link.send(encode_command(requested, self._posture))
        elif command is not None:
            self._link.send(encode_command(Fsm.INVALID, replace(command, dq=np.zeros(z1.N_JOINTS))))
        else:
            self._link.send(encode_command(Fsm.INVALID))  # only at the start, when no answer is known: asks for one

    def _last_command(self) -> JointCommands | None:
        data = self._page.command()
        try:
            return None if data is None else decode_command(data).joints()
        except ProtocolError:
            return None

    def _end(self, reason: str) -> None:
        self.phase, self.reason = Phase.ENDED, reason


def _is_posture(command: JointCommands | None) -> bool:
    return command is not None and bool((command.kp[: z1.N_ARM] > 0.0).all())
