"""The sender of chunks: its lead, and motions sent by a process that is late."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest

from hal.backends.mock_arm import MockArm
from hal.base import z1
from hal.base.clock import Clock, WallClock
from hal.base.errors import InvalidValueError, StoppedError
from hal.base.messages import TrajectoryChunk
from hal.servo.servo import Servo
from hal.servo.servo_thread import ServoThread
from tests.support.errors import raises
from tests.support.lockstep import Bench
from z1_runtime.motion.executor import AdaptiveLead, ChunkSender, Executor, ExecutorConfig, SenderConfig
from z1_runtime.motion.limits import MotionLimits
from z1_runtime.motion.trajectory import joint_move

Q_START = np.append(z1.Q_HOME, -1.0)
Q_GOAL = Q_START + np.array([1.5, 0.6, -0.9, 0.6, 0.3, -1.2, 0.3])
MOVE = joint_move(Q_START, Q_GOAL, MotionLimits.at_speed(1.0))


class LateClock:
    """The clock of a process that is woken later than it asked for."""

    def __init__(self, clock: Clock, late_s: list[float]) -> None:
        self._clock, self._late_s = clock, late_s

    def now_s(self) -> float:
        return self._clock.now_s()

    def sleep_until(self, t_s: float) -> None:
        self._clock.sleep_until(t_s + (self._late_s.pop(0) if self._late_s else 0.0))


def chunks() -> deque[TrajectoryChunk]:
    n = len(MOVE.t_s)
    return deque(
        TrajectoryChunk(trajectory_id=1, t_s=MOVE.t_s[p], q=MOVE.q[p], dq=MOVE.dq[p], final=p.stop == n)
        for p in MOVE.split(0.1)
    )


def play(late_s: list[float], config: SenderConfig) -> Bench:
    """Send the motion with wake-ups that are late; return the bench after its end."""
    bench = Bench(Q_START)
    ChunkSender(bench.servo, chunks(), config, AdaptiveLead(config)).run(LateClock(bench.clock, list(late_s)))
    bench.wait(MOVE.duration_s + 0.5)
    return bench


LATE = [0.1, 0.15, 0.22, 0.3, 0.35, 0.3]


@pytest.mark.integration
def test_a_lead_that_adapts_carries_a_motion_over_pauses_that_drop_it_otherwise() -> None:
    fixed = play(LATE, SenderConfig(max_lead_s=SenderConfig().lead_s))
    assert not fixed.servo.status().finished
    assert "buffer underrun" in fixed.servo.status().reason
    adaptive = play(LATE, SenderConfig())
    assert adaptive.servo.status().finished
    assert adaptive.servo.read_state().q == pytest.approx(Q_GOAL, abs=1e-3)


def test_the_lead_follows_the_lateness_up_to_its_maximum_and_back() -> None:
    config = SenderConfig()
    lead = AdaptiveLead(config)
    assert lead.lead_s == config.lead_s
    lead.record(0.1)
    assert lead.lead_s == pytest.approx(config.lead_s + 0.2)
    for _ in range(1000):
        lead.record(0.0)
    assert lead.lead_s == pytest.approx(config.lead_s, abs=1e-3)
    lead.record(9.0)
    assert lead.lead_s == config.max_lead_s


def test_a_sender_ends_when_its_motion_is_over() -> None:
    bench, left = Bench(Q_START), chunks()
    bench.at_time(0.3, lambda: bench.servo.stop("the button"))
    ChunkSender(bench.servo, left, SenderConfig(), AdaptiveLead(SenderConfig())).run(bench.clock)
    assert len(left) > 2
    assert bench.servo.status().reason == "the button"


def test_a_rejected_chunk_ends_the_sending() -> None:
    bench = Bench(Q_START)
    bench.servo.stop("the button")
    with raises(StoppedError, "stopped"):
        ChunkSender(bench.servo, chunks(), SenderConfig(), AdaptiveLead(SenderConfig())).run(bench.clock)


def test_a_sender_that_is_stopped_sends_nothing_more() -> None:
    bench = Bench(Q_START)
    ChunkSender(bench.servo, chunks(), SenderConfig(), AdaptiveLead(SenderConfig())).run(bench.clock, lambda: True)
    assert bench.servo.status().buffered_s == 0.0


def test_a_maximum_lead_below_the_lead_is_rejected() -> None:
    with raises(InvalidValueError, "invalid_value"):
        SenderConfig(lead_s=0.5, max_lead_s=0.4)


@pytest.mark.integration
def test_on_the_wall_clock_a_thread_sends_and_a_busy_watcher_delays_nothing() -> None:
    clock = WallClock()
    servo = Servo(MockArm(clock, q=Q_START), clock)
    servo.connect()
    servo.claim("test")
    executor = Executor(servo, clock, ExecutorConfig())
    naps = [0.0, 0.0, 0.6]  # a watcher that takes longer than the lead
    executor.watchers.append(lambda *_: clock.sleep_until(clock.now_s() + (naps.pop(0) if naps else 0.0)))
    with ServoThread(servo, clock):
        executor.execute(MOVE)
        assert servo.status().finished
        servo.stop("the button")
        with pytest.raises(StoppedError):
            executor.execute(joint_move(Q_GOAL, Q_START))
