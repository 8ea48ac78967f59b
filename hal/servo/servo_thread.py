"""The real-time thread of the servo: one tick every 2 ms on absolute deadlines of the wall clock."""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import resource
import sys
from typing import TYPE_CHECKING

from hal.base.background_loop import BackgroundLoop
from hal.base.clock import Clock
from hal.base.messages import ServoMode
from hal.base.z1 import CONTROL_PERIOD_S

if TYPE_CHECKING:
    from hal.servo.servo import Servo

log = logging.getLogger(__name__)

_FIFO_PRIORITY = 80  # above the twin's controller thread (70), which answers the servo
_MAX_FAILURES = 5  # in a row: 10 ms without a command, hardly more than the wire loses by itself
_SWITCH_INTERVAL_S = 0.0005  # a quarter of a period; CPython's default of 5 ms would miss two ticks
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # <sys/mman.h>


class ServoThread(BackgroundLoop):
    """A daemon thread that calls `servo.tick()` every control period, in a `with` block or by `start` and `stop`.

    A late tick shifts all later deadlines: no period is skipped and none is caught up in a burst. An error in a tick
    latches the stop, with the error as its reason, and the ticks go on: they brake and hold, while an arm that gets no
    commands may go limp. After a few errors in a row the arm itself is stopped, and `stop` raises the last one.

    Args:
        servo: connected before the start.
        clock: the wall clock.
        cpu: core to which the thread is pinned; None = any.
    """

    def __init__(self, servo: Servo, clock: Clock, *, cpu: int | None = None) -> None:
        super().__init__("servo")
        self._servo = servo
        self._clock = clock
        self._cpu = cpu

    def _run(self) -> None:
        try:
            self._servo.real_time = _request_real_time(self._cpu)
            self._servo.periods.set_measuring(True)
            self._run_ticks()
        except Exception as error:  # every type: whatever ends the ticks, the arm must be stopped
            self._servo.fail(_describe(error))
            raise
        finally:
            self._servo.periods.set_measuring(False)
            gc.unfreeze()
            gc.enable()

    def _run_ticks(self) -> None:
        clock, tick, stop_requested = self._clock, self._servo.tick, self._stop_requested.is_set
        deadline_s, failures = clock.now_s(), 0
        while not stop_requested():
            clock.sleep_until(deadline_s)
            late_s = clock.now_s() - deadline_s
            # Less than half a period of jitter is absorbed by the next deadline; more shifts the whole schedule.
            if late_s > 0.5 * CONTROL_PERIOD_S:
                deadline_s += late_s
            try:
                tick()
                failures = 0
            except Exception as error:  # every type: the next tick brakes, where this one may have met a defect
                failures += 1
                if failures > _MAX_FAILURES:
                    raise
                self._servo.stop(_describe(error))
                log.exception("the servo's tick failed")
            deadline_s += CONTROL_PERIOD_S


def _describe(error: Exception) -> str:
    return f"the servo's tick failed: {type(error).__name__}: {error}"


def _request_real_time(cpu: int | None) -> tuple[str, ...]:
    """Request real-time scheduling, a core and locked memory for the calling thread; return what was granted.

    Continues without what the system denies: a desktop without privileges still runs, with late ticks.
    """
    granted, denied = [], []
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    # A collection pauses every thread: from now on it runs only in `collect_garbage`, with the arm at rest.
    gc.disable()
    gc.freeze()  # objects that exist by now are no garbage while the servo runs; skipping them keeps those pauses short
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))  # 0: this thread alone
        granted.append("SCHED_FIFO")
    except OSError:
        denied.append("SCHED_FIFO")
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
            granted.append(f"core {cpu}")
        except OSError:
            denied.append(f"core {cpu}")
    (granted if _lock_memory() else denied).append("locked memory")
    log.info("servo thread: granted %s", ", ".join(granted) or "nothing")
    if denied:
        log.warning("servo thread: not granted %s; expect late ticks, and see `./z1 doctor`", ", ".join(denied))
    return tuple(granted)


def collect_garbage(servo: Servo) -> None:
    """Run Python's garbage collector, which is off while a servo ticks, if the arm is at rest."""
    if servo.status().mode in (ServoMode.HOLDING, ServoMode.STOPPED):
        gc.collect()


def may_lock_memory() -> bool:
    """Return whether the servo locks its memory: only without a limit, which a later allocation could exceed."""
    return resource.getrlimit(resource.RLIMIT_MEMLOCK)[1] == resource.RLIM_INFINITY


def _lock_memory() -> bool:
    if not may_lock_memory():
        return False
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    libc = ctypes.CDLL(None, use_errno=True)
    # ONFAULT locks each page when it is first used, instead of the whole address space at once.
    return libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) == 0
