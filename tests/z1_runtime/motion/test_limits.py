"""Hastening ends where the arm's own limits do."""

from __future__ import annotations

import pytest

from hal.base import z1
from z1_runtime.motion.limits import MotionLimits


def test_hastened_limits_are_higher_by_the_factor_and_end_at_the_arms_own():
    slow, full = MotionLimits.at_speed(0.2), MotionLimits.at_speed(1.0)
    twice = slow.scaled(2.0)
    assert twice.velocity == pytest.approx(0.4 * z1.DQ_MAX)
    assert twice.angular_jerk == pytest.approx(2.0 * slow.angular_jerk)
    most = slow.scaled(100.0)
    assert most.acceleration == pytest.approx(full.acceleration)
    assert most.linear_velocity == pytest.approx(full.linear_velocity)


@pytest.mark.parametrize("factor", [0.0, -1.0, float("nan"), float("inf")])
def test_a_factor_that_is_none_is_refused(factor):
    with pytest.raises(ValueError, match="positive and finite"):
        MotionLimits().scaled(factor)
