"""Measure how long a stop takes while clients attack the servo, in this process.

    python -m scripts.measure.measure_stop --stops 20

For each attack a trajectory plays at 500 Hz while two threads send that attack without a pause. A stop is requested,
and the time is measured until the request returns, until the first braking setpoint is sent, and until the command is
at rest. The target: braking begins within 20 ms, and the command is at rest 0.24 s later at most.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import tyro

from hal.backends.mock_arm import MockArm
from hal.base.clock import WallClock
from hal.base.errors import HalError
from hal.base.messages import ArmSetpoint, ServoMode, TrajectoryChunk
from hal.base.z1 import N_JOINTS, Q_HOME
from hal.servo.guard import Guard
from hal.servo.servo import Servo
from hal.servo.servo_thread import ServoThread

_START = np.append(Q_HOME, -0.5)
_STEP = np.array([0.8, 0.4, -0.5, 0.3, 0.3, -0.6, -0.4])
_SENDERS = 2
_WIDTHS = (16, 16, 12, 12)


@dataclass(frozen=True, kw_only=True)
class Options:
    """Extent of the measurement."""

    stops: int = 10
    """Stops for each attack."""
    only: str = ""
    """Part of the name of the attacks to run; empty = all."""


def _still(trajectory_id: int, t_s: list[float] | np.ndarray) -> TrajectoryChunk:
    q = np.tile(_START, (len(t_s), 1))
    return TrajectoryChunk(trajectory_id=trajectory_id, t_s=np.asarray(t_s), q=q, dq=0 * q)


def _attacks(servo: Servo) -> dict[str, Callable[[], object]]:
    """Return the attacks, each a request that is sent repeatedly."""
    number = itertools.count(1000)
    here = ArmSetpoint(q=_START, dq=np.zeros(N_JOINTS))
    longest = np.arange(9_999) * 0.002
    return {
        "nothing": lambda: threading.Event().wait(0.05),
        "two points 60,000 s apart": lambda: servo.stream(_still(next(number), [0.0, 60_000.0])),
        "two points 1e18 s apart": lambda: servo.stream(_still(next(number), [0.0, 1e18])),
        "the longest chunk allowed": lambda: servo.stream(_still(next(number), longest)),
        "100,000 points": lambda: servo.stream(_still(next(number), np.arange(100_000) * 1e-4)),
        "a number of 400 digits": lambda: servo.stream(_still(10**400, [0.0, 0.1])),
        "setpoints": lambda: servo.send(here),
        "claims": lambda: servo.claim("measure"),
        "heartbeats": servo.heartbeat,
        "status and health": lambda: (servo.status(), servo.health()),
    }


def main(options: Options) -> None:
    """Run all attacks and print their latencies."""
    clock, guard = WallClock(), Guard()
    servo = _TimedServo(MockArm(clock, q=_START), clock, guard=guard)
    servo.connect()
    print(f"Latency of the stop, median / maximum of {options.stops}; ticks are counted from the request.")
    names = ("returned [ms]", "braking [ms]", "ticks", "rest, ticks")
    heads = (f"{name:>{width}s}" for name, width in zip(names, _WIDTHS, strict=True))
    print(f"{'attack':27s} {'requests/s':>10s} {' '.join(heads)}")
    with ServoThread(servo, clock):
        for name, attack in _attacks(servo).items():
            if options.only not in name:
                continue
            ended, count = threading.Event(), itertools.count()
            threads = [
                threading.Thread(target=_repeat, args=(attack, ended, count), daemon=True) for _ in range(_SENDERS)
            ]
            begin_s = clock.now_s()
            for thread in threads:
                thread.start()
            figures = np.array([_time_stop(servo, clock) for _ in range(options.stops)])
            rate = next(count) / (clock.now_s() - begin_s)
            ended.set()
            for thread in threads:
                thread.join()
            widths = zip(figures.T, _WIDTHS, (2, 1, 0, 0), strict=True)
            columns = (f"{f'{np.median(x):.{n}f} / {x.max():.{n}f}':>{width}s}" for x, width, n in widths)
            print(f"{name:27s} {rate:10.0f} {' '.join(columns)}", flush=True)
    servo.disconnect()


class _TimedServo(Servo):
    """Servo that records its last tick before a stop, the first that brakes, and the first at rest."""

    requested_s = np.inf

    def tick(self) -> None:
        super().tick()
        snapshot = self._snapshot
        if snapshot is None or snapshot.stamp_s < self.requested_s:
            self.before, self.braking, self.rest = self.periods.ticks, (0.0, 0), 0
        elif not self.braking[1] and snapshot.mode in (ServoMode.BRAKING, ServoMode.STOPPED):
            self.braking = self.clock.now_s(), self.periods.ticks
        if self.braking[1] and not self.rest and snapshot is not None and snapshot.mode is ServoMode.STOPPED:
            self.rest = self.periods.ticks


def _repeat(attack: Callable[[], object], ended: threading.Event, count: itertools.count[int]) -> None:
    while not ended.is_set():
        with suppress(HalError):
            attack()
        next(count)


def _time_stop(servo: _TimedServo, clock: WallClock) -> tuple[float, float, int, int]:
    """Play a motion and stop it; return the times until the request returned and braking began [ms], and the numbers of
    ticks until braking and rest."""
    servo.requested_s = np.inf
    servo.rearm()
    clock.sleep_until(clock.now_s() + 0.05)
    servo.claim("measure")
    start = servo.status().q_command
    step = _STEP if np.abs(start - _START)[0] < 0.2 else _START - start
    _stream_move(servo, start, step)
    clock.sleep_until(clock.now_s() + 0.4)
    servo.requested_s = requested_s = clock.now_s()
    servo.stop("the measured stop")
    returned_s = clock.now_s()
    while not servo.rest:
        clock.sleep_until(clock.now_s() + 0.005)
    braking_s, braking = servo.braking
    times_ms = 1e3 * (returned_s - requested_s), 1e3 * (braking_s - requested_s)
    return *times_ms, braking - servo.before, servo.rest - servo.before


def _stream_move(servo: Servo, start: np.ndarray, step: np.ndarray) -> None:
    t_s = np.arange(501) * 0.002
    s = t_s[:, None]
    chunk = TrajectoryChunk(
        trajectory_id=servo.status().trajectory_id + 2000,
        t_s=t_s,
        q=start + (10 * s**3 - 15 * s**4 + 6 * s**5) * step,
        dq=(30 * s**2 - 60 * s**3 + 30 * s**4) * step,
        final=True,
    )
    with suppress(HalError):  # an attack may have been faster; then the stop is at rest
        servo.stream(chunk)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
