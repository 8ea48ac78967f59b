"""Token bucket and limited log, on a clock moved by hand."""

from __future__ import annotations

import logging

import pytest

from hal.base.clock import ManualClock
from hal.bus.rate_limit import LimitedLog, TokenBucket


def test_a_burst_passes_and_the_rest_waits():
    clock = ManualClock()
    bucket = TokenBucket(10.0, 3, clock)
    assert [bucket.take() for _ in range(3)] == [0, 0, 0]
    assert bucket.take() == pytest.approx(0.1)
    clock.advance(0.1)
    assert bucket.take() == pytest.approx(0.1)
    clock.advance(100.0)
    assert [bucket.take() for _ in range(3)] == [0, 0, 0]
    assert bucket.take() > 0


def test_a_flood_of_log_lines_becomes_one_in_ten_seconds_with_their_number(caplog):
    clock = ManualClock()
    log = LimitedLog(logging.getLogger("test"), clock)
    with caplog.at_level(logging.WARNING):
        for _ in range(10):
            for _ in range(1000):
                log.warning("line of %s", "a flood")
            clock.advance(10.0)
    assert len(caplog.records) <= 3 + 10
    assert "999 more" in caplog.records[-1].getMessage()
    assert "a flood" in caplog.records[0].getMessage()
