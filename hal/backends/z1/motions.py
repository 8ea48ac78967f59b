"""Motions that the vendor's controller executes by itself: started here, monitored, and ended where they end."""

from __future__ import annotations

from threading import RLock

import numpy as np

from hal.backends.z1.client import Z1Client
from hal.backends.z1.config import Z1Mode
from hal.backends.z1.mode_machine import ModeMachine
from hal.backends.z1.requests import StateRequester
from hal.base import z1
from hal.base.errors import CommandRejectedError, HalError, HalTimeoutError
from hal.z1_protocol.controller import TrajectoryCommand
from hal.z1_protocol.states import MOVES, Fsm

# With three points on a line the controller moves for ever (measured); flat arcs have a radius beyond the arm's reach.
_MIN_ARC_M = 0.002

MOVE_TIMEOUT_S = 60.0
"""Timeout of one motion [s]; those of the vendor's controller take a few seconds (measured)."""


class ControllerMotions:
    """Motions to postures and labels, back to start, and the calibration of the zero.

    Args:
        client: connection to the controller.
        requests: requests of its states.
        modes: mode machine, which suspends our commands meanwhile.
        lock: the driver's lock; it is taken here, and released between the steps of a wait, so that other threads
            can read and stop.
    """

    def __init__(self, client: Z1Client, requests: StateRequester, modes: ModeMachine, lock: RLock) -> None:
        self._client = client
        self._requests = requests
        self._modes = modes
        self._lock = lock

    def begin(self, state: Fsm, body: TrajectoryCommand | str | None = None) -> None:
        """Start a motion; see `Z1Arm.begin_move`."""
        with self._lock:
            client = self._modes.require_command_authority()
            leaves_low_level = state is Fsm.BACKTOSTART and self._modes.mode is Z1Mode.LOW_LEVEL
            if self._modes.mode is not Z1Mode.TRACKING and not leaves_low_level:
                raise CommandRejectedError(
                    f"Z1: the arm is in mode {self._modes.mode}; motions of the controller start in tracking.",
                    code="wrong_mode",
                )
            if state is Fsm.MOVEC and isinstance(body, TrajectoryCommand):
                _check_arc(client.newest.pose, body)
            self._modes.suspend()
            try:
                self._requests.request(state, body)
                self._modes.mode = Z1Mode.TRACKING  # where every motion of the controller ends
            except HalError:
                self._modes.resume()
                raise

    def finish(self, timeout_s: float) -> None:
        """Wait for the end of the motion, then hold; see `Z1Arm.end_move`."""
        clock = self._client.clock
        end_s = clock.now_s() + timeout_s
        if not self._modes.moving:
            return
        while True:
            with self._lock:
                state = self._step()
            if state is None:
                return
            if clock.now_s() > end_s:
                raise HalTimeoutError(
                    f"Z1: the controller is still in {state.name} after {timeout_s} s and continues. Wait, or stop it.",
                    code="motion_timeout",
                )
            clock.sleep_until(clock.now_s() + z1.CONTROL_PERIOD_S)

    def _step(self) -> Fsm | None:
        """Exchange one datagram; return the controller's state, None once the motion has ended as it should."""
        client = self._modes.require_connection()
        client.receive()
        client.check_age()
        state = client.newest.state
        if not self._modes.moving:
            raise CommandRejectedError("Z1: the motion was stopped before its end.", code="motion_stopped")
        if state in MOVES:
            client.send()  # the controller falls to PASSIVE after 2.2 s without a datagram (measured)
            return state
        self._modes.resume()
        if state is not Fsm.JOINTCTRL:
            raise CommandRejectedError(
                f"Z1: the motion ended in {state.name} instead of JOINTCTRL; inspect the arm.", code="motion_failed"
            )
        return None

    def calibrate(self) -> None:
        """Make the present pose the zero of all joints; see `Z1Arm.calibrate`."""
        with self._lock:
            self._modes.require_connection()
            self._requests.request(Fsm.PASSIVE)
            self._modes.observe()
            self._requests.calibrate(MOVE_TIMEOUT_S)


def _check_arc(pose: np.ndarray, move: TrajectoryCommand) -> None:
    """Check that the pivot's position and the two of an arc are not on one line.

    Raises:
        CommandRejectedError: they are (`arc_on_line`).
    """
    start, middle, end = pose[3:], *move.poses[:, 3:]
    longest = max(np.linalg.norm(middle - start), np.linalg.norm(end - start), np.linalg.norm(end - middle))
    height_m = np.linalg.norm(np.cross(middle - start, end - start)) / max(longest, 1e-9)
    if height_m < _MIN_ARC_M:
        raise CommandRejectedError(
            f"Z1: the start and the two poses of an arc are within {1e3 * height_m:.1f} mm of one line (allowed from "
            f"{1e3 * _MIN_ARC_M:.0f} mm): the controller would never end it. Use MOVEL, or another middle pose.",
            code="arc_on_line",
        )
