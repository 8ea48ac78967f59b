"""The thread that ticks the servo on the wall clock."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from hal.backends.mock_arm import MockArm
from hal.base.clock import ManualClock, WallClock
from hal.base.messages import ServoMode
from hal.base.z1 import CONTROL_PERIOD_S, N_ARM
from hal.servo.servo import Servo
from hal.servo.servo_thread import ServoThread
from tests.support.hal.servo_bench import START, STEP, move

pytestmark = pytest.mark.integration


class CountingServo:
    """A servo that records the times of its ticks, and stalls once."""

    def __init__(self, clock: ManualClock, stall_at: int = -1) -> None:
        self.clock = clock
        self.stall_at = stall_at
        self.woke_s: list[float] = []
        self.enough = threading.Event()
        self.periods = Servo(MockArm(clock), clock).periods

    def tick(self) -> None:
        self.woke_s.append(self.clock.now_s())
        if len(self.woke_s) == self.stall_at:
            self.clock.advance(0.0305)
        if len(self.woke_s) == 60:
            self.enough.set()
        if len(self.woke_s) >= 60:
            threading.Event().wait(0.001)  # yield the interpreter to the test


def ticks_of(stall_at: int = -1) -> np.ndarray:
    servo = CountingServo(ManualClock(), stall_at)
    with ServoThread(servo, servo.clock):  # type: ignore[arg-type]
        assert servo.enough.wait(20.0)
    return np.array(servo.woke_s[:60])


def test_it_ticks_on_absolute_deadlines() -> None:
    assert ticks_of() == pytest.approx(np.arange(60) * CONTROL_PERIOD_S)


def test_after_a_stall_it_neither_skips_nor_catches_up() -> None:
    periods = np.diff(ticks_of(stall_at=20))
    assert periods[19] == pytest.approx(0.0305)
    assert np.delete(periods, 19) == pytest.approx(np.full(58, CONTROL_PERIOD_S))


def test_a_servo_on_the_wall_clock_plays_a_trajectory_and_measures_its_periods() -> None:
    clock = WallClock()
    arm = MockArm(clock, q=START)
    servo = Servo(arm, clock)
    servo.connect()
    servo.claim("test")
    thread = ServoThread(servo, clock)
    thread.start()
    thread.start()
    servo.stream(move(duration_s=1.0))
    while not (servo.status().finished or servo.status().reason):
        clock.sleep_until(clock.now_s() + 0.02)
    assert thread.is_running
    thread.stop()
    thread.stop()
    status = servo.status()
    assert status.finished
    assert status.q_command[:N_ARM] == pytest.approx((START + STEP)[:N_ARM])
    assert status.ticks >= 501
    assert 0 < status.period_ms_p50 <= status.period_ms_p999


def test_an_error_in_one_tick_latches_the_stop_and_the_ticks_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = WallClock()
    servo = Servo(MockArm(clock, q=START), clock)
    servo.connect()
    servo.claim("test")
    servo.stream(move(duration_s=1.0))
    with ServoThread(servo, clock):
        while servo.status().trajectory_time_s < 0.2:
            clock.sleep_until(clock.now_s() + 0.005)
        run = servo._cycle.run
        errors: list[Exception] = [ZeroDivisionError("a defect")]
        monkeypatch.setattr(servo._cycle, "run", lambda now_s: fail_once(errors) or run(now_s))
        while servo.status().mode is not ServoMode.STOPPED:
            clock.sleep_until(clock.now_s() + 0.005)
        ticks = servo.status().ticks
        while servo.status().ticks < ticks + 10:
            clock.sleep_until(clock.now_s() + 0.005)
    assert "the servo's tick failed: ZeroDivisionError: a defect" in servo.status().reason
    assert 0.0 < servo.status().q_command[0] - START[0] < STEP[0]


def fail_once(errors: list[Exception]) -> None:
    if errors:
        raise errors.pop()


def test_an_error_in_every_tick_latches_the_stop_and_is_raised_when_the_thread_is_stopped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = WallClock()
    arm = MockArm(clock, q=START)
    servo = Servo(arm, clock)
    servo.connect()
    thread = ServoThread(servo, clock)
    thread.start()
    monkeypatch.setattr(arm, "read_state", lambda: 1 / 0)
    while thread.is_running:
        clock.sleep_until(clock.now_s() + 0.005)
    status = servo.status()
    assert status.mode is ServoMode.STOPPED
    assert "the servo's tick failed" in status.reason
    with pytest.raises(ZeroDivisionError):
        thread.stop()
