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
        self._reads = False

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
            self._count, self._active_s, self._reads = count, now_s, False
        elif now_s - self._active_s >= SILENCE_S and now_s - self._sent_s >= PERIOD_S:
            if self._reads:  # from the second time on: what the driver has not read yet is none of ours
                self._read(now_s)
            self._reads = True
            self._send(now_s)
            self.stepped_in += 1

    def _read(self, now_s: float) -> None:
        for _ in range(_MAX_DATAGRAMS):
            data = self._link.receive()
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
        if state is not None and (requested is not Fsm.INVALID or command is None):
            known = command is not None
            posture = compute_posture(state.joints, command.q if known else None, command.kp if known else None)
            self._link.send(encode_command(requested, posture))
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
