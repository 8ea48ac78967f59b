"""Supervised threads: restarts with a limit, and a failure that reaches the one who can stop the arm."""

from __future__ import annotations

import pytest

from hal.base.background_loop import BackgroundLoop, RestartBudget, RestartPolicy, run_supervised
from hal.base.clock import ManualClock

AT_ONCE = RestartPolicy(max_restarts=3, pause_s=0.0)


class Work:
    """Work that fails a number of times and then ends."""

    def __init__(self, failures: int) -> None:
        self.failures = failures
        self.runs = 0

    def __call__(self) -> None:
        self.runs += 1
        if self.runs <= self.failures:
            raise ZeroDivisionError(f"failure {self.runs}")


def test_work_that_ends_is_run_once() -> None:
    work, reasons = Work(0), []
    assert run_supervised("test", work, reasons.append, policy=AT_ONCE) is None
    assert (work.runs, reasons) == (1, [])


def test_work_that_fails_a_few_times_is_started_again() -> None:
    work, reasons = Work(3), []
    assert run_supervised("test", work, reasons.append, policy=AT_ONCE) is None
    assert (work.runs, reasons) == (4, [])


def test_work_that_keeps_failing_is_given_up_and_its_reason_reported() -> None:
    work, reasons = Work(99), []
    error = run_supervised("reader", work, reasons.append, policy=AT_ONCE)
    assert isinstance(error, ZeroDivisionError)
    assert work.runs == 4
    assert reasons == ["the reader thread failed: ZeroDivisionError: failure 4"]


def test_failures_far_apart_in_time_do_not_add_up() -> None:
    clock = ManualClock()
    budget = RestartBudget(RestartPolicy(max_restarts=1, window_s=60.0), clock)
    assert budget.allows_restart()
    clock.advance(61.0)
    assert budget.allows_restart()
    assert not budget.allows_restart()


class FailingLoop(BackgroundLoop):
    def _run(self) -> None:
        raise ZeroDivisionError("a defect")


def test_a_failed_loop_reports_its_reason_and_raises_where_it_is_stopped() -> None:
    reasons: list[str] = []
    loop = FailingLoop("reader", restarts=AT_ONCE, on_failure=reasons.append)
    loop.start()
    assert loop._thread is not None
    loop._thread.join(10.0)
    assert reasons == ["the reader thread failed: ZeroDivisionError: a defect"]
    with pytest.raises(ZeroDivisionError):
        loop.stop()
