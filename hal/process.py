"""The HAL process: one rig, its servo at 500 Hz, and the link to its clients."""

from __future__ import annotations

import itertools
import logging
import os
import signal
from collections.abc import Callable
from contextlib import ExitStack, suppress
from threading import Event, Thread

import numpy as np

from hal.base.errors import CommandRejectedError, HalError, InvalidValueError
from hal.base.messages import ServoMode
from hal.base.z1 import CONTROL_PERIOD_S, N_ARM
from hal.bus.server import HalServer
from hal.bus.session import BusConfig
from hal.parking import Parking, park
from hal.rig import Rig
from hal.servo.guard import Guard, Workspace
from hal.servo.limits import ServoLimits
from hal.servo.monitor_only import MonitorOnlyServo
from hal.servo.servo import Servo
from hal.servo.servo_thread import ServoThread, collect_garbage

_LOG = logging.getLogger(__name__)
HEARTBEAT_TIMEOUT_S = 0.15
"""Maximum time without a heartbeat of the owner in motion [s]: seven of them at 50 Hz. With `ServoLimits.brake_s` the
arm is at rest within 0.4 s of the owner's last one."""
_MAX_BRAKING_S = 2.0  # several times `ServoLimits.brake_s`, for an arm that lags behind its command
_AT_REST_RAD_S = 0.01
_POLL_S = 0.05
_COLLECT_EVERY = 1200  # polls: once a minute


def stop_on_signals(stop_event: Event, force_exit_event: Event | None = None) -> None:
    """Set `stop_event` at the first SIGTERM, SIGINT or SIGHUP, and `force_exit_event` at the second.

    Call it in the main thread, before `serve`.
    """
    # A handler interrupts the main thread, which may hold the event's own lock: another thread has to set it.
    read_end, write_end = os.pipe()

    def wait() -> None:
        for event in filter(None, (stop_event, force_exit_event)):
            os.read(read_end, 1)
            event.set()

    Thread(target=wait, name="signals", daemon=True).start()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: os.write(write_end, b"!"))


def serve(
    rig: Rig,
    config: BusConfig,
    stop_event: Event,
    *,
    on_ready: Callable[[], None] | None = None,
    limits: ServoLimits | None = None,
    workspace: Workspace | None = None,
    cpu: int | None = None,
    force_exit_event: Event | None = None,
    monitor_only: bool = False,
) -> None:
    """Serve `rig` until `stop_event` is set, then brake, park if the rig asks for it, hold, and disconnect.

    Args:
        rig: not yet connected, on the wall clock.
        config: address to listen on.
        stop_event: ends the process; `stop_on_signals` connects it to the signals.
        on_ready: called once everything answers; clients see the answer at `srv/hello`.
        limits: of the servo; None = the Z1's.
        workspace: of the safety guard; None = above the arm's table.
        cpu: core of the servo thread; None = any.
        force_exit_event: also ends the parking; the arm then holds its position.
        monitor_only: measure and publish only; the arm is neither commanded nor stopped nor parked.

    Raises:
        HalError: a device does not answer, the port is taken, or the servo failed while running.
        InvalidValueError: the rig runs in lock-step (`lockstep_rig`).
    """
    if rig.call_every_tick is not None:
        raise InvalidValueError(
            "hal process: a lock-step rig cannot be served. Make the rig with the wall clock.", code="lockstep_rig"
        )
    kind = MonitorOnlyServo if monitor_only else Servo
    servo = kind(rig.arm, rig.clock, limits, heartbeat_timeout_s=HEARTBEAT_TIMEOUT_S)
    ticking = ServoThread(servo, rig.clock, cpu=cpu)
    shutdown = _ShutdownSequence(servo, ticking, rig.park, force_exit_event or Event())
    start = _Start(rig)
    with ExitStack() as undo:  # each step that was reached is undone, in reverse order
        start.connect_camera()
        undo.callback(rig.camera.disconnect)
        # Before the arm, which must not wait for a second of loading without a client
        servo.set_safety_guard(Guard(workspace))
        servo.connect()
        undo.callback(servo.disconnect)
        undo.callback(start.give_back)
        undo.callback(shutdown.disable_motors)  # undone after the last tick, see `ticking.stop` below
        if rig.follow_arm is not None:
            rig.follow_arm(servo.read_state)
        ticking.start()
        undo.callback(ticking.stop)
        _await_first_tick(servo, ticking)
        server = undo.enter_context(HalServer(servo, rig.camera, rig.clock, config))
        if not monitor_only:
            undo.callback(shutdown.bring_to_rest)  # undone first, while the servo ticks and clients can stop it
        start.finished = True
        _LOG.info("serving robot %s at %s", config.robot, config.endpoint)
        if on_ready is not None:
            on_ready()
        for poll in itertools.count(1):
            if stop_event.wait(_POLL_S) or not ticking.is_running:
                break
            if poll % _COLLECT_EVERY == 0:
                collect_garbage(servo)
            if server.failed.is_set():
                server.failed.clear()
                # The process goes on, as an arm without a client may go limp.
                with suppress(CommandRejectedError):  # monitor-only: another program moves the arm
                    servo.stop("a thread of the HAL's link failed; see the traceback in its log, and restart the HAL")


def _await_first_tick(servo: Servo, ticking: ServoThread) -> None:
    """Wait for the first tick; from then on only the servo's thread reads the arm, whichever threads read the servo."""
    pause = Event()
    while ticking.is_running and not servo.status().ticks:
        pause.wait(CONTROL_PERIOD_S)


class _Start:
    """A start that changes nothing at the arm until every other device is there, and gives it back when it fails."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.finished = False
        """True from when clients are served; the arm then ends as the shutdown says."""

    def connect_camera(self) -> None:
        """Connect the camera; where it is missing, look for the arm too, so that both are reported together.

        Raises:
            HalError: of the camera, or of both devices (`devices`); the arm was not touched.
        """
        try:
            self._rig.camera.connect()
        except HalError as missing:
            try:
                if self._rig.find_arm is not None:
                    self._rig.find_arm()
            except HalError as error:
                raise HalError(f"arm: {error} camera: {missing}", code="devices") from error
            raise

    def give_back(self) -> None:
        """Return the arm to the state it was found in, unless the start was finished."""
        if not self.finished and self._rig.give_back is not None:
            self._rig.give_back()


class _ShutdownSequence:
    """The steps that bring the arm to rest at the end of the process."""

    def __init__(self, servo: Servo, ticking: ServoThread, parking: Parking | None, force_exit: Event) -> None:
        self._servo, self._ticking = servo, ticking
        self._parking, self._force_exit = parking, force_exit
        self._parked = False

    def bring_to_rest(self) -> None:
        """Park the arm if configured, then brake, while the servo still ticks; clients can watch and stop it."""
        if self._parking is not None and self._ticking.is_running:
            self._parked = park(self._servo, self._parking, self._force_exit)
        self._servo.stop("the HAL process is ending")
        pause = Event()
        waited_s = 0.0
        while self._ticking.is_running and not self._is_at_rest() and waited_s < _MAX_BRAKING_S:
            pause.wait(_POLL_S)
            waited_s += _POLL_S

    def _is_at_rest(self) -> bool:
        """Return True when the servo is stopped and the arm, if it can still be measured, is at rest."""
        try:
            speed = np.abs(self._servo.read_state().dq[:N_ARM]).max()
        except HalError:
            speed = 0.0  # a silent arm cannot be waited for
        return self._servo.status().mode is ServoMode.STOPPED and bool(speed < _AT_REST_RAD_S)

    def disable_motors(self) -> None:
        """Disable the motors of a parked arm if configured; called after the last tick."""
        if self._parked and self._parking is not None and self._parking.disable_motors is not None:
            self._parking.disable_motors()
            _LOG.info("hal process: the motors are disabled")
