"""Motions that the vendor's controller makes by itself: begun here, watched, and ended where they end."""

from __future__ import annotations

from hal.backends.z1.config import Z1Mode
from hal.backends.z1.modes import Z1Modes
from hal.base import z1
from hal.base.errors import CommandRejectedError, HalError, HalTimeoutError
from hal.z1_protocol.controller import TrajectoryCommand
from hal.z1_protocol.states import MOVES, Fsm

_MOVE_TIMEOUT_S = 60.0


class Z1Moves(Z1Modes):
    """Moves to postures and labels, back to start, and calibrates."""

    def begin_move(self, state: Fsm, body: TrajectoryCommand | str | None = None) -> None:
        """Start a motion that the controller makes by itself (one of `hal.z1_protocol.states.MOVES`); `send` is refused
        until it is over.

        Raises:
            CommandRejectedError: the controller does not, or the arm is not in TRACKING.
        """
        with self._lock:
            client = self._ready()
            if self._mode is not Z1Mode.TRACKING:
                raise CommandRejectedError(f"the arm is in mode {self._mode}; its own motions start from tracking.")
            self._moving = True
            try:
                client.ask(state, body)
            except HalError:
                self._resume()
                raise

    def end_move(self, timeout_s: float = _MOVE_TIMEOUT_S) -> None:
        """Wait until the motion is over, then hold where the arm is.

        Raises:
            HalTimeoutError: it is not over in time and goes on, or the controller stopped answering.
            CommandRejectedError: it was stopped, or the controller went elsewhere.
        """
        end_s = self.clock.now_s() + timeout_s
        if not self._moving:
            return
        while True:
            with self._lock:  # not for longer: others may want to read, or to stop
                client = self._connected()
                client.receive()
                client.check_answers()
                state = client.newest.state
                if not self._moving:
                    raise CommandRejectedError("the motion was stopped before its end.")
                if state not in MOVES:
                    self._resume()
                    if state is Fsm.JOINTCTRL:
                        return
                    raise CommandRejectedError(
                        f"the motion ended in {state.name} instead of JOINTCTRL; look at the arm."
                    )
                client.send()
            if self.clock.now_s() > end_s:
                raise HalTimeoutError(f"the controller is still in {state.name} after {timeout_s} s; it goes on.")
            self.clock.sleep_until(self.clock.now_s() + z1.CONTROL_PERIOD_S)

    def run_label(self, label: str) -> None:
        """Move to a saved pose, at the controller's own speed, and wait for it (`forward`, `startFlat`, …).

        Raises:
            CommandRejectedError: no such label.
        """
        self.begin_move(Fsm.TOSTATE, label)
        self.end_move()

    def back_to_start(self) -> None:
        """Move to `startFlat`, at the controller's own speed, and wait for it."""
        self.begin_move(Fsm.BACKTOSTART)
        self.end_move()

    def calibrate(self) -> None:
        """Make the present pose the zero of all joints, as the vendor's `calibration` does; ends in PASSIVE.

        Raises:
            CommandRejectedError, HalTimeoutError: the controller does not.
        """
        self.go_passive()
        with self._lock:
            self._client.ask(Fsm.CALIBRATION)
            self._client.wait_for(Fsm.PASSIVE, _MOVE_TIMEOUT_S)
