"""Measure the period jitter of the 500 Hz servo on this machine, and of a bare C loop under the same load.

    python -m scripts.measure.measure_servo --seconds 60 --load vision

The servo (with the mock arm) and the bare loop run at the same time, each in its own process, so that both get the
same stalls, and both request SCHED_FIFO. The bare loop is C, compiled with `cc`; without a compiler it is libc's
clock_nanosleep called by ctypes.
The target: the servo's p99 and p99.9 are at most 1.3 times the bare loop's, and no setpoint is skipped.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from hal.backends.mock_arm import MockArm
from hal.base.clock import Stopwatch, WallClock
from hal.base.messages import TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S, N_JOINTS, Q_MAX, Q_MIN
from hal.servo.servo import Servo
from hal.servo.servo_thread import ServoThread

_BARE_C = r"""
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
int main(int argc, char **argv) {
    long n = atol(argv[1]), period = atol(argv[2]);
    double *out = malloc(n * sizeof *out);
    struct timespec due, now;
    struct sched_param priority = { .sched_priority = 80 };
    sched_setscheduler(0, SCHED_FIFO, &priority);  // as the servo does; continues without the permission
    clock_gettime(CLOCK_MONOTONIC, &due);
    for (long i = 0; i < n; i++) {
        due.tv_nsec += period;
        if (due.tv_nsec >= 1000000000L) { due.tv_nsec -= 1000000000L; due.tv_sec++; }
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
        clock_gettime(CLOCK_MONOTONIC, &now);
        out[i] = now.tv_sec + 1e-9 * now.tv_nsec;
        if (now.tv_sec > due.tv_sec || (now.tv_sec == due.tv_sec && now.tv_nsec - due.tv_nsec > period / 2)) due = now;
    }
    fwrite(out, sizeof *out, n, stdout);
    return 0;
}
"""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Duration and load of the measurement."""

    seconds: float = 20.0
    """Duration [s]."""
    load: Literal["nothing", "vision"] = "nothing"
    """Other load of the machine: `vision` is a process that detects objects without a pause."""
    cpu: int | None = None
    """Core that the servo's thread is pinned to; by default any."""


def main(options: Options) -> None:
    """Run both loops and print their periods."""
    n = round(options.seconds / CONTROL_PERIOD_S)
    with tempfile.TemporaryDirectory() as folder:
        command, kind = _bare_command(Path(folder), n)
        with (
            _run_load(options.load, Path(folder)) as detections,  # first: both loops then run under it from their start
            subprocess.Popen(command, stdout=subprocess.PIPE) as bare,
        ):
            before = detections()
            servo_ms, summary = _run_servo(options)
            count = detections() - before
            assert bare.stdout is not None
            bare_ms = 1e3 * np.diff(np.frombuffer(bare.stdout.read()))
    print(f"period [ms]         p50     p99   p99.9     max  late by more than half a period   ({kind})")
    for name, periods in (("bare loop", bare_ms), ("servo", servo_ms)):
        figures = " ".join(f"{x:7.3f}" for x in (*np.percentile(periods, [50, 99, 99.9]), periods.max()))
        print(f"{name:15s} {figures}  {(periods > 1.5e3 * CONTROL_PERIOD_S).sum()} of {len(periods)}")
    print(summary)
    if options.load != "nothing":
        print(f"load: {options.load}, {count / options.seconds:.1f} detections/s")
    ratios = np.percentile(servo_ms, [99, 99.9]) / np.percentile(bare_ms, [99, 99.9])
    print(f"p99 of the servo is {ratios[0]:.2f}, p99.9 {ratios[1]:.2f} times the bare loop's (target: 1.3 or less)")


def _bare_command(folder: Path, n: int) -> tuple[list[str], str]:
    period_ns = str(round(1e9 * CONTROL_PERIOD_S))
    if compiler := shutil.which("cc"):
        source, program = folder / "bare.c", folder / "bare"
        source.write_text(_BARE_C)
        subprocess.run([compiler, "-O2", "-o", str(program), str(source)], check=True)
        return [str(program), str(n), period_ns], "C"
    return [
        sys.executable,
        "-c",
        "from scripts.measure.measure_servo import *; run_bare_python()",
        str(n),
    ], "libc by ctypes"


def run_bare_python() -> None:
    """Run the C loop's algorithm with libc's clock_nanosleep, and write the wake-up times to stdout."""
    n = int(sys.argv[1])
    clock, sleep_until = WallClock(), _make_nanosleep()
    times, due_s = np.zeros(n), clock.now_s()
    for i in range(n):
        due_s += CONTROL_PERIOD_S
        sleep_until(due_s)
        times[i] = clock.now_s()
        if times[i] - due_s > CONTROL_PERIOD_S / 2:
            due_s = times[i]
    sys.stdout.buffer.write(times.tobytes())


def _make_nanosleep() -> Callable[[float], None]:
    class Timespec(ctypes.Structure):
        _fields_ = (("sec", ctypes.c_long), ("nsec", ctypes.c_long))

    libc = ctypes.CDLL(None)

    def sleep_until(t_s: float) -> None:
        due = Timespec(int(t_s), int(1e9 * (t_s % 1.0)))
        libc.clock_nanosleep(1, 1, ctypes.byref(due), None)  # CLOCK_MONOTONIC, TIMER_ABSTIME

    return sleep_until


@contextmanager
def _run_load(load: str, folder: Path) -> Iterator[Callable[[], int]]:
    """Run the load within, once it has started; yield a function that returns the number of detections so far."""
    if load == "nothing":
        yield lambda: 0
        return
    marks = folder / "detections"  # one byte for each
    code = "from scripts.measure.measure_servo import *; run_vision()"
    with marks.open("wb") as out, subprocess.Popen([sys.executable, "-c", code], stdout=out) as process:
        pause = threading.Event()
        while not marks.stat().st_size:
            pause.wait(0.1)
            if process.poll() is not None:
                raise RuntimeError(f"the {load} process ended with code {process.returncode}; its error is above.")
        try:
            yield lambda: marks.stat().st_size
        finally:
            process.kill()


def run_vision() -> None:
    """Detect objects in a frame of the twin repeatedly, and write a byte to stdout each time."""
    from hal.base.z1 import Q_HOME, T_FLANGE_CAMERA
    from sim_twin.backends import make_rig
    from z1_runtime.geometry.kinematics import Kinematics
    from z1_runtime.perception.detector import make_detector

    detector = make_detector("yolo")
    rig = make_rig(lockstep=True)
    rig.camera.connect()
    frame, T_base_camera = rig.camera.wait_for_frame(1.0), Kinematics().flange(Q_HOME) @ T_FLANGE_CAMERA
    while True:
        detector.detect(frame, T_base_camera)
        sys.stdout.buffer.write(b".")
        sys.stdout.buffer.flush()  # the file's size is the count


class _TimedServo(Servo):
    """Servo that records its wake-up times, the duration of each tick, and its time in the trajectory."""

    def __init__(self, arm: MockArm, clock: WallClock, capacity: int) -> None:
        super().__init__(arm, clock)
        self.woke_s, self.cost_ms, self.played_s = np.zeros((3, capacity))  # a tick must allocate nothing
        self.count = 0

    def tick(self) -> None:
        i = self.count % len(self.woke_s)
        self.woke_s[i] = self.clock.now_s()
        watch = Stopwatch()
        super().tick()
        self.cost_ms[i] = watch.lap_ms()
        self.played_s[i] = 0.0 if self._snapshot is None else self._snapshot.trajectory_time_s
        self.count += 1


def _run_servo(options: Options) -> tuple[np.ndarray, str]:
    """Return the periods [ms] of a moving servo, and a summary of its status."""
    clock = WallClock()
    capacity = round(1.2 * options.seconds / CONTROL_PERIOD_S)  # a reserve: the thread ticks a little longer
    # From the middle of all ranges the swing of 0.4 rad stays within the joint limits.
    servo = _TimedServo(MockArm(clock, q=(Q_MIN + Q_MAX) / 2), clock, capacity)
    servo.connect()
    servo.claim("measure_servo")
    ended = threading.Event()
    with ServoThread(servo, clock, cpu=options.cpu):
        sender = threading.Thread(target=_swing, args=(servo, ended), daemon=True)
        sender.start()
        clock.sleep_until(clock.now_s() + options.seconds)
        count, status, granted = servo.count, servo.status(), ", ".join(servo.real_time) or "nothing"
        ended.set()
        sender.join()
    servo.disconnect()
    cost_us = 1e3 * np.percentile(servo.cost_ms[:count], [50, 99])
    skipped = int((np.diff(servo.played_s[:count]) > 1.5 * CONTROL_PERIOD_S).sum())
    why = f"; it ended: {status.reason}" if status.reason else ""
    summary = (
        f"servo: {status.overruns} overruns counted, {skipped} setpoints skipped of {count}; a tick takes p50 "
        f"{cost_us[0]:.0f} us, p99 {cost_us[1]:.0f} us; its thread was granted {granted}{why}"
    )
    return 1e3 * np.diff(servo.woke_s[:count]), summary


def _swing(servo: Servo, ended: threading.Event) -> None:
    """Stream a gentle swing of all joints in chunks of 0.1 s, about 0.3 s ahead, until `ended`."""
    centre = servo.read_state().q
    start_s, sent_s = servo.clock.now_s(), 0.0
    while not ended.is_set():
        t_s = sent_s + np.linspace(0, 0.1, 6)
        # sin³ has no acceleration where it begins: from rest without a jump
        q = centre + (0.1 * np.sin(t_s) ** 3)[:, None] * np.ones(N_JOINTS)
        dq = (0.3 * np.sin(t_s) ** 2 * np.cos(t_s))[:, None] * np.ones(N_JOINTS)
        servo.stream(TrajectoryChunk(trajectory_id=1, t_s=t_s, q=q, dq=dq))
        sent_s += 0.1
        servo.clock.sleep_until(start_s + sent_s - 0.3)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
