"""The HAL process: one rig, its servo at 500 Hz, and the link to whoever commands it."""

from __future__ import annotations

import itertools
import logging
import os
import signal
from collections.abc import Callable
from contextlib import ExitStack
from threading import Event, Thread

import numpy as np

from hal.base.errors import HalError, InvalidValueError
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
"""How long the owner may be silent in motion [s]."""
_BRAKING_S = 2.0
_AT_REST_RAD_S = 0.01
_LOOK_S = 0.05
_COLLECT_EVERY = 1200  # looks: once a minute


def stop_on_signals(stop_event: Event, force_exit_event: Event | None = None) -> None:
    """Set `stop_event` at SIGTERM, SIGINT and SIGHUP, and `force_exit_event` at the next of them; for the main thread,
    before `serve`."""
    # A handler interrupts the main thread, which may hold the event's own lock: another thread has to set it.
    heard, told = os.pipe()

    def wait() -> None:
        for event in filter(None, (stop_event, force_exit_event)):
            os.read(heard, 1)
            event.set()

    Thread(target=wait, name="signals", daemon=True).start()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: os.write(told, b"!"))


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
    readonly: bool = False,
) -> None:
    """Serve `rig` until `stop_event` is set, then brake, park if the rig says so, hold and let go of everything.

    Args:
        rig: not yet connected, living by the wall clock.
        config: where to listen.
        stop_event: ends it; `stop_on_signals` ties it to the signals.
        on_ready: called once everything answers; over the link the sign is the answer at `srv/hello`.
        limits: of the servo; None = the Z1's.
        workspace: where the arm may be; None = above its table.
        cpu: the core for the servo thread; None = any.
        force_exit_event: ends the parking, too: the arm then holds where it is.
        readonly: measure and publish only; the arm is neither commanded nor stopped nor parked.

    Raises:
        HalError: a device does not answer, the port is taken, or the servo or the server failed while running.
        ValueError: the rig is a lock-step one.
    """
    if rig.call_every_tick is not None:
        raise InvalidValueError("a lock-step rig has no time of its own to be served by; make it with the wall clock.")
    kind = MonitorOnlyServo if readonly else Servo
    servo = kind(rig.arm, rig.clock, limits, heartbeat_timeout_s=HEARTBEAT_TIMEOUT_S)
    ticking = ServoThread(servo, rig.clock, cpu=cpu)
    shutdown = _ShutdownSequence(servo, ticking, rig.park, force_exit_event or Event())
    with ExitStack() as undo:  # in reverse order, whatever of it was reached
        connect_devices(servo, rig)
        undo.callback(servo.disconnect)
        undo.callback(shutdown.disable_motors)
        undo.callback(rig.camera.disconnect)
        servo.set_safety_guard(Guard(workspace))  # a second to load: whoever has no arm need not wait for it
        ticking.start()
        undo.callback(ticking.stop)
        _await_first_tick(servo, ticking)
        server = undo.enter_context(HalServer(servo, rig.camera, rig.clock, config))
        if not readonly:
            undo.callback(shutdown.come_to_rest)
        _LOG.info("serving robot %s at %s", config.robot, config.endpoint)
        if on_ready is not None:
            on_ready()
        for look in itertools.count(1):
            if stop_event.wait(_LOOK_S) or not ticking.is_running:
                break
            if look % _COLLECT_EVERY == 0:
                collect_garbage(servo)
            if server.failed.is_set():
                raise HalError("a thread of the link's server died; its traceback is above. The arm is being stopped.")


def _await_first_tick(servo: Servo, ticking: ServoThread) -> None:
    """From then on the arm is asked by the servo's thread alone, however many ask the servo."""
    pause = Event()
    while ticking.is_running and not servo.status().ticks:
        pause.wait(CONTROL_PERIOD_S)


def connect_devices(servo: Servo, rig: Rig) -> None:
    """Connect arm and camera; independent ones at the same time, so that whoever has neither learns it of both at once.

    Raises:
        HalError: of the one that does not answer, or what both say; nothing is left open.
    """
    looking = _Attempt(rig.camera.connect)
    if rig.independent:
        looking.start()
    try:
        servo.connect()
    except HalError as error:
        if not rig.independent:
            raise
        looking.join()
        if looking.error is None:
            rig.camera.disconnect()
            raise
        raise HalError(f"arm: {error} camera: {looking.error}") from error
    if not rig.independent:
        looking.run()
    else:
        looking.join()
    if looking.error is not None:
        servo.disconnect()
        raise looking.error


class _Attempt(Thread):
    """A call, in a thread or not, that keeps what it raises."""

    def __init__(self, call: Callable[[], None]) -> None:
        super().__init__(name="attempt", daemon=True)
        self._call = call
        self.error: Exception | None = None

    def run(self) -> None:
        try:
            self._call()
        except Exception as error:  # of every kind: it is raised where it is waited for
            self.error = error


class _ShutdownSequence:
    """What is done with the arm once the process is to end."""

    def __init__(self, servo: Servo, ticking: ServoThread, parking: Parking | None, force_exit: Event) -> None:
        self._servo, self._ticking = servo, ticking
        self._parking, self._force_exit = parking, force_exit
        self._parked = False

    def come_to_rest(self) -> None:
        """Brake, and park if that is wanted, while the servo still ticks; clients see it happen, and may stop it."""
        if self._parking is not None and self._ticking.is_running:
            self._parked = park(self._servo, self._parking, self._force_exit)
        self._servo.stop("the HAL process is ending")
        pause = Event()
        waited_s = 0.0
        while self._ticking.is_running and not self._rests() and waited_s < _BRAKING_S:
            pause.wait(_LOOK_S)
            waited_s += _LOOK_S

    def _rests(self) -> bool:
        """Whether the servo is stopped, and the arm with it, as far as it can be measured."""
        try:
            speed = np.abs(self._servo.read_state().dq[:N_ARM]).max()
        except HalError:
            speed = 0.0
        return self._servo.status().mode is ServoMode.STOPPED and bool(speed < _AT_REST_RAD_S)

    def disable_motors(self) -> None:
        """Let the motors of a parked arm go, if that is wanted; for when nothing ticks any more."""
        if self._parked and self._parking is not None and self._parking.disable_motors is not None:
            self._parking.disable_motors()
            _LOG.info("the motors are soft")
