"""The monitor-only servo."""

from __future__ import annotations

import numpy as np

from hal.backends.mock_arm import MockArm
from hal.base.clock import ManualClock
from hal.base.errors import CommandRejectedError, LeaseError
from hal.base.messages import ArmSetpoint, ServoMode
from hal.base.z1 import CONTROL_PERIOD_S
from hal.servo.monitor_only import MonitorOnlyServo
from tests.support.errors import raises
from tests.support.hal.servo_bench import START, move, setpoint


class ExternallyMovedArm(MockArm):
    """An arm that another program moves, and that accepts no command."""

    def send(self, setpoint: ArmSetpoint) -> ArmSetpoint:
        raise AssertionError("commanded by a monitor-only servo")

    def push(self, rad: float) -> None:
        self._target = self._target + rad


def test_it_reports_the_arms_position_and_sends_nothing() -> None:
    clock = ManualClock(5.0)
    arm = ExternallyMovedArm(clock, q=START)
    servo = MonitorOnlyServo(arm, clock)
    servo.connect()
    for _ in range(500):
        arm.push(1e-3)
        clock.advance(CONTROL_PERIOD_S)
        servo.tick()
    status = servo.status()
    assert (status.mode, status.reason) == (ServoMode.HOLDING, "")
    assert servo.read_state().q[0] > START[0] + 0.3
    np.testing.assert_allclose(status.q_command, servo.read_state().q)
    servo.disconnect()


def test_it_rejects_every_claim_command_and_stop() -> None:
    clock = ManualClock(5.0)
    servo = MonitorOnlyServo(ExternallyMovedArm(clock, q=START), clock)
    servo.connect()
    servo.tick()
    with raises(LeaseError, "monitor_only"):
        servo.claim("demo")
    for command in (lambda: servo.stream(move(), owner="demo"), lambda: servo.send(setpoint(START), owner="demo")):
        with raises(LeaseError, "not_claimed"):
            command()
    with raises(CommandRejectedError, "monitor_only"):
        servo.stop("the button")


def test_a_fault_of_the_arm_is_reported() -> None:
    clock = ManualClock(5.0)
    arm = ExternallyMovedArm(clock, q=START)
    servo = MonitorOnlyServo(arm, clock)
    servo.connect()
    arm.inject_fault("overheat joint 2")
    servo.tick()
    assert "overheat joint 2" in servo.status().reason
