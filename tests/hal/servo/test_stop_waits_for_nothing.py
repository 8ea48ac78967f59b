"""Attacks on the stop: whatever clients send, it is latched at once and the command is at rest after a braking."""

from __future__ import annotations

from threading import Thread

import numpy as np
import pytest

from hal.base.errors import CommandRejectedError, HalError, InvalidMessageError
from hal.base.messages import ServoMode, TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S, N_JOINTS
from hal.servo.guard import Guard
from hal.servo.limits import ServoLimits
from hal.servo.trajectory_buffer import MAX_POINTS
from tests.support.errors import raises
from tests.support.hal.servo_bench import START, Bench, move

_AT_REST_TICKS = round(ServoLimits().brake_s / CONTROL_PERIOD_S) + 1


def still(trajectory_id: int, t_s: list[float] | np.ndarray) -> TrajectoryChunk:
    q = np.tile(START, (len(t_s), 1))
    return TrajectoryChunk(trajectory_id=trajectory_id, t_s=np.asarray(t_s), q=q, dq=0 * q)


ATTACKS = {
    "16 hours in two points": lambda: still(2, [0.0, 60_000.0]),
    "1e18 s in two points": lambda: still(2, [0.0, 1e18]),
    "more points than the buffer": lambda: still(2, np.arange(MAX_POINTS + 1) * 1e-3),
    "points without distance in time": lambda: still(2, [0.0, 1e-300]),
    "the greatest number": lambda: still(2**53, [0.0, 0.1]),
    "a number of 400 digits": lambda: still(10**400, [0.0, 0.1]),
    "a position of 1e300 rad": lambda: TrajectoryChunk(
        trajectory_id=2, t_s=np.array([0.0, 0.1]), q=np.full((2, N_JOINTS), 1e300), dq=np.zeros((2, N_JOINTS))
    ),
}


@pytest.fixture(scope="module")
def guard() -> Guard:
    return Guard()


@pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS.keys())
def test_an_attack_is_rejected_and_the_motion_and_its_stop_are_as_without_it(attack, guard: Guard) -> None:
    bench = Bench(guard=guard)
    bench.servo.stream(move())
    bench.run(0.5)
    with pytest.raises((CommandRejectedError, InvalidMessageError)):
        bench.servo.stream(attack())
    bench.run(CONTROL_PERIOD_S)
    assert bench.mode is ServoMode.TRACKING
    bench.servo.stop("the button")
    bench.run(CONTROL_PERIOD_S)
    assert bench.mode is ServoMode.BRAKING
    bench.run(_AT_REST_TICKS * CONTROL_PERIOD_S)
    assert (bench.mode, bench.reason) == (ServoMode.STOPPED, "the button")


class InterruptedGuard(Guard):
    """A guard that is asked to wait: in the middle of a check, with the mailbox locked, `interrupt` runs."""

    interrupt = staticmethod(lambda: None)

    def find_violation(self, q: np.ndarray, q_now: np.ndarray):
        interrupt, self.interrupt = self.interrupt, lambda: None
        interrupt()
        return super().find_violation(q, q_now)


def test_a_stop_in_the_middle_of_a_check_is_latched_at_once_and_the_chunk_moves_nothing() -> None:
    guard = InterruptedGuard()
    bench = Bench(guard=guard)
    latched = []

    def stop_from_another_client() -> None:
        thread = Thread(target=bench.servo.stop, args=("the button",), daemon=True)
        thread.start()
        thread.join(10.0)
        assert not thread.is_alive(), "the stop waits for the check"
        bench.run(CONTROL_PERIOD_S)
        latched.append(bench.mode)

    guard.interrupt = stop_from_another_client
    bench.servo.stream(move())
    assert latched == [ServoMode.STOPPED]
    bench.run(0.5)
    assert np.array_equal(bench.commanded()[-1], START)
    bench.servo.rearm()
    bench.servo.claim("test")
    bench.run(0.5)
    assert np.array_equal(bench.commanded()[-1], START), "what was accepted while stopped is dropped"


def test_a_stop_that_arrives_while_another_client_rearms_stays() -> None:
    bench = Bench()
    bench.servo.stop("the first")
    bench.run(0.01)
    mailbox = bench.servo._mailbox
    drop = mailbox._drop
    mailbox._drop = lambda: (drop(), bench.servo.stop("the second"))[0]  # type: ignore[method-assign]
    bench.servo.rearm()
    bench.run(0.01)
    assert (bench.mode, bench.reason) == (ServoMode.STOPPED, "the second")


def test_an_unforeseen_error_is_the_error_of_its_request_alone(guard: Guard, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(guard=guard)
    bench.servo.stream(move(until_s=0.5))
    bench.run(0.2)
    monkeypatch.setattr("hal.servo.command_mailbox.extend_buffer", lambda *_: 1 / 0)
    with raises(CommandRejectedError, "internal_error") as caught:
        bench.servo.stream(move(from_s=0.5))
    assert "ZeroDivisionError" in str(caught.value)
    monkeypatch.undo()
    bench.servo.stream(move(from_s=0.5))
    bench.run(1.0)
    assert bench.servo.status().finished


def test_random_numbers_in_a_chunk_are_rejected_or_played_within_the_limits() -> None:
    rng = np.random.default_rng(0)
    bench, accepted = Bench(), 0
    for _ in range(300):
        n = int(rng.integers(1, 6))
        scale = 10.0 ** rng.uniform(-12, 20, 3)
        try:
            chunk = TrajectoryChunk(
                trajectory_id=bench.servo.status().trajectory_id + 1,
                t_s=np.cumsum(rng.random(n)) * scale[0] * (rng.random() < 0.5),
                q=bench.servo.status().q_command + rng.normal(size=(n, N_JOINTS)) * scale[1],
                dq=rng.normal(size=(n, N_JOINTS)) * scale[2],
                final=bool(rng.random() < 0.5),
            )
            bench.servo.stream(chunk)
            accepted += 1
        except HalError:
            pass
        bench.run(2 * CONTROL_PERIOD_S)
    jerk = np.abs(np.diff(bench.commanded(), n=3, axis=0)) / CONTROL_PERIOD_S**3
    assert (jerk <= 1.05 * ServoLimits().brake_dddq_max).all()
