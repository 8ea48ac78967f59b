"""The HAL process: one rig, its servo at 500 Hz, and the link to whoever commands it."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable
from contextlib import ExitStack
from threading import Event, Thread

from hal.bus.server import HalServer
from hal.bus.session import BusConfig
from hal.errors import HalError
from hal.guard import Guard, Workspace
from hal.limits import ServoLimits
from hal.messages import ServoMode
from hal.rig import Rig
from hal.servo import Servo
from hal.servo_thread import ServoThread
from hal.z1 import CONTROL_PERIOD_S

_LOG = logging.getLogger(__name__)
HEARTBEAT_TIMEOUT_S = 0.15
"""How long the owner may be silent in motion [s]."""
_BRAKING_S = 2.0
_LOOK_S = 0.05


def stop_on_signals(stop_event: Event) -> None:
    """Set `stop_event` at SIGTERM, SIGINT and SIGHUP; for the main thread, before `serve`."""
    # A handler interrupts the main thread, which may hold the event's own lock: another thread has to set it.
    heard, told = os.pipe()

    def wait() -> None:
        os.read(heard, 1)
        stop_event.set()

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
) -> None:
    """Serve `rig` until `stop_event` is set, then brake, hold and let go of everything.

    Args:
        rig: not yet connected, living by the wall clock.
        config: where to listen.
        stop_event: ends it; `stop_on_signals` ties it to the signals.
        on_ready: called once everything answers; over the link the sign is the answer at `srv/hello`.
        limits: of the servo; None = the Z1's.
        workspace: where the arm may be; None = above its table.
        cpu: the core for the servo thread; None = any.

    Raises:
        HalError: a device does not answer, the port is taken, or the servo or the server failed while running.
        ValueError: the rig is a lock-step one.
    """
    if rig.call_every_tick is not None:
        raise ValueError("a lock-step rig has no time of its own to be served by; make it with the wall clock.")
    guard = Guard(workspace)
    servo = Servo(rig.arm, rig.clock, limits, heartbeat_timeout_s=HEARTBEAT_TIMEOUT_S, guard=guard)
    ticking = ServoThread(servo, rig.clock, cpu=cpu)
    with ExitStack() as undo:  # in reverse order, whatever of it was reached
        servo.connect()
        undo.callback(servo.disconnect)
        rig.camera.connect()
        undo.callback(rig.camera.disconnect)
        ticking.start()
        undo.callback(ticking.stop)
        _await_first_tick(servo, ticking)
        server = undo.enter_context(HalServer(servo, rig.camera, rig.clock, config))
        undo.callback(_come_to_rest, servo, ticking)
        _LOG.info("serving robot %s at %s", config.robot, config.endpoint)
        if on_ready is not None:
            on_ready()
        while not stop_event.wait(_LOOK_S) and ticking.alive:
            if server.failed.is_set():
                raise HalError("a thread of the link's server died; its traceback is above. The arm is being stopped.")


def _await_first_tick(servo: Servo, ticking: ServoThread) -> None:
    """From then on the arm is asked by the servo's thread alone, however many ask the servo."""
    pause = Event()
    while ticking.alive and not servo.status().ticks:
        pause.wait(CONTROL_PERIOD_S)


def _come_to_rest(servo: Servo, ticking: ServoThread) -> None:
    """Brake while the servo still ticks; clients see it happen, and can command nothing any more."""
    servo.stop("the HAL process is ending")
    pause = Event()
    waited_s = 0.0
    while ticking.alive and servo.status().mode is not ServoMode.STOPPED and waited_s < _BRAKING_S:
        pause.wait(_LOOK_S)
        waited_s += _LOOK_S
