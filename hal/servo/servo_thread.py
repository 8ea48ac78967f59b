"""Ticks a servo at 500 Hz on absolute deadlines of the wall clock."""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import resource
import sys
import threading
from types import TracebackType
from typing import TYPE_CHECKING, Self

from hal.base.clock import Clock
from hal.base.messages import ServoMode
from hal.base.z1 import CONTROL_PERIOD_S

if TYPE_CHECKING:
    from hal.servo.servo import Servo

log = logging.getLogger(__name__)

_FIFO_PRIORITY = 80
_SWITCH_INTERVAL_S = 0.0005
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


class ServoThread:
    """A daemon thread that calls `servo.tick()` every control period, in a `with` block or by `start` and `stop`.

    A late cycle moves all later deadlines with it: nothing is skipped and nothing comes in a burst.

    Args:
        servo: what is ticked; connected before the start.
        clock: the wall's.
        cpu: the core to stay on; None = any.
    """

    def __init__(self, servo: Servo, clock: Clock, *, cpu: int | None = None) -> None:
        self._servo = servo
        self._clock = clock
        self._cpu = cpu
        self._thread: threading.Thread | None = None
        self._end = threading.Event()
        self._error: Exception | None = None

    def start(self) -> None:
        """Start ticking. Harmless when it does already."""
        if self._thread is not None:
            return
        self._end.clear()
        self._error = None
        self._thread = threading.Thread(target=self._run, name="servo", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the ticking; the arm holds its last setpoint. Harmless when it does not run.

        Raises:
            Exception: whatever a tick raised; the servo was latched and the arm stopped when it did.
        """
        if self._thread is None:
            return
        self._end.set()
        self._thread.join()
        self._thread = None
        self._servo.periods.measure(False)
        if self._error is not None:
            raise self._error

    @property
    def is_running(self) -> bool:
        """Whether it ticks."""
        return self._thread is not None and self._thread.is_alive()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _run(self) -> None:
        try:
            self._servo.real_time = _prepare(self._cpu)
            self._servo.periods.measure(True)
            self._tick_for_ever()
        except Exception as error:  # every kind: a servo that dies must say so and leave the arm stopped
            self._error = error
            log.exception("the servo's tick failed; the arm is stopped")
            self._servo.fail(f"the servo's tick failed: {type(error).__name__}: {error}")
        finally:
            gc.unfreeze()
            gc.enable()

    def _tick_for_ever(self) -> None:
        clock, tick, ended = self._clock, self._servo.tick, self._end.is_set
        deadline_s = clock.now_s()
        while not ended():
            clock.sleep_until(deadline_s)
            late_s = clock.now_s() - deadline_s
            if late_s > 0.5 * CONTROL_PERIOD_S:
                deadline_s += late_s
            tick()
            deadline_s += CONTROL_PERIOD_S


def _prepare(cpu: int | None) -> tuple[str, ...]:
    """Ask for what makes the calling thread punctual, go on without what is not permitted; return what was granted."""
    granted, refused = [], []
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    # A collection holds up every thread: from now on somebody calls `collect_garbage`, who knows that the arm rests.
    gc.disable()
    gc.freeze()  # what exists by now is no garbage while the servo runs; not looking at it keeps those short
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))
        granted.append("SCHED_FIFO")
    except OSError:
        refused.append("SCHED_FIFO")
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
            granted.append(f"core {cpu}")
        except OSError:
            refused.append(f"core {cpu}")
    (granted if _lock_memory() else refused).append("locked memory")
    log.info("servo thread: granted %s", ", ".join(granted) or "nothing")
    if refused:
        log.warning("servo thread: not granted %s; expect late ticks, and see `./z1 doctor`", ", ".join(refused))
    return tuple(granted)


def collect_garbage(servo: Servo) -> None:
    """Do what Python's collector may not do by itself while a servo ticks, if its arm is at rest."""
    if servo.status().mode in (ServoMode.HOLDING, ServoMode.STOPPED):
        gc.collect()


def _lock_memory() -> bool:
    # With a finite limit a later allocation would fail instead of being merely slow.
    _, most = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if most != resource.RLIM_INFINITY:
        return False
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (most, most))
    libc = ctypes.CDLL(None, use_errno=True)
    return libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) == 0
