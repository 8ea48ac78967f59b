"""The health of a HAL process, as read by a client that commands nothing."""

from __future__ import annotations

import pytest

from hal.base.clock import WallClock
from hal.base.errors import HalTimeoutError
from hal.base.messages import ServoMode
from hal.bus.health import describe_health, wait_for_health
from tests.support.errors import raises
from tests.support.hal.bus_hal import free_config, wait_until

pytestmark = pytest.mark.integration


def test_the_health_of_a_servo_is_its_threads_measurement(hal, remote_arm):
    remote_arm.claim()
    wait_until(lambda: hal.servo.health().rate_hz > 0)
    health = wait_for_health(hal.config, WallClock())
    assert health.mode is ServoMode.HOLDING
    assert health.owner.startswith("tester-")
    assert 0.0 <= health.command_age_s < 1.0
    assert 0.0 < health.period_ms_p50 <= health.period_ms_p99 <= health.period_ms_p999 <= health.period_ms_max
    assert health.faults == ()
    assert health.real_time == hal.servo.real_time
    assert f"at {health.rate_hz:.1f} Hz" in describe_health(health)
    assert f"last command of {health.owner}" in describe_health(health)


def test_faults_are_reported(hal):
    hal.arm.inject_fault("overheat joint 2")
    wait_until(lambda: hal.servo.status().mode is ServoMode.STOPPED)
    health = wait_until(lambda: (h := wait_for_health(hal.config, WallClock())).mode is ServoMode.STOPPED and h)
    assert health.faults == ("the arm reports overheat joint 2",)
    assert describe_health(health).endswith("no command owner; the arm reports overheat joint 2")


def test_without_a_hal_process_it_raises():
    with raises(HalTimeoutError, "no_hal"):
        wait_for_health(free_config(connect_timeout_s=0.2), WallClock())
