"""Period statistics."""

from __future__ import annotations

import pytest

from hal.servo.status import PeriodStatistics, PeriodSummary


def test_periods_are_summarised_only_while_measured() -> None:
    periods = PeriodStatistics(capacity=1000)
    for i in range(10):
        periods.record(0.002 * i)
    assert periods.summary() == PeriodSummary()
    assert (periods.ticks, periods.overruns) == (10, 0)


def test_percentiles_are_those_of_the_last_periods_in_the_ring() -> None:
    periods = PeriodStatistics(capacity=100)
    periods.set_measuring(True)
    now_s = 0.0
    for step_s in [0.5] * 100 + [0.002] * 100:
        periods.record(now_s)
        now_s += step_s
    periods.record(now_s)
    assert periods.summary() == pytest.approx((500.0, 2.0, 2.0, 2.0, 2.0))


def test_a_cycle_more_than_half_a_period_late_is_an_overrun() -> None:
    periods = PeriodStatistics()
    for now_s in (0.0, 0.002, 0.0049, 0.0080, 0.0100):
        periods.record(now_s)
    assert periods.overruns == 1


def test_a_summary_is_cached_for_a_second() -> None:
    periods = PeriodStatistics()
    periods.set_measuring(True)
    for i in range(10):
        periods.record(0.002 * i)
    first = periods.summary()
    periods.record(1.0)
    assert periods.summary() == first
    for i in range(500):
        periods.record(1.0 + 0.003 * i)
    assert periods.summary().p50_ms == pytest.approx(3.0)
    assert periods.summary().max_ms == pytest.approx(982.0)


class FilledMeanwhile(PeriodStatistics):
    """Statistics into which the tick records a period whenever their reader looks."""

    @property
    def _filled(self) -> int:
        self.count += 1
        return self.count

    @_filled.setter
    def _filled(self, value: int) -> None:
        self.count = value

    count = 0


def test_a_period_recorded_while_the_percentiles_are_computed_does_no_harm() -> None:
    periods = FilledMeanwhile()
    periods._ring_s[:] = 0.002
    for reading in range(1, 40):
        periods.count, periods.ticks = reading, 1000 * reading
        assert periods.summary().p50_ms == pytest.approx(2.0)


def test_the_time_between_two_ticking_threads_is_no_period() -> None:
    periods = PeriodStatistics()
    for start_s in (0.0, 7.0):
        periods.set_measuring(True)
        for i in range(10):
            periods.record(start_s + 0.002 * i)
        periods.set_measuring(False)
    assert periods.overruns == 0
    assert periods.summary() == pytest.approx((500.0, 2.0, 2.0, 2.0, 2.0))
