"""Scaled limits end at the arm's own."""

from __future__ import annotations

import pytest

from hal.base import z1
from hal.base.errors import InvalidValueError
from tests.support.errors import raises
from z1_runtime.motion.limits import MotionLimits


def test_scaled_limits_are_higher_by_the_factor_and_end_at_the_arms_own():
    slow, full = MotionLimits.at_speed(0.2), MotionLimits.at_speed(1.0)
    twice = slow.scaled(2.0)
    assert twice.velocity == pytest.approx(0.4 * z1.DQ_MAX)
    assert twice.angular_jerk == pytest.approx(2.0 * slow.angular_jerk)
    highest = slow.scaled(100.0)
    assert highest.acceleration == pytest.approx(full.acceleration)
    assert highest.linear_velocity == pytest.approx(full.linear_velocity)


@pytest.mark.parametrize("factor", [0.0, -1.0, float("nan"), float("inf")])
def test_an_invalid_factor_is_rejected(factor):
    with raises(InvalidValueError, "invalid_value"):
        MotionLimits().scaled(factor)
