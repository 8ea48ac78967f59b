"""Parking folds the arm before its motors are disabled, except where it must not move."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event

import numpy as np
import pytest

from hal.backends.mock_arm import MockArm
from hal.base import z1
from hal.base.clock import WallClock
from hal.base.messages import ServoMode
from hal.parking import Parking, park
from hal.servo.guard import Guard
from hal.servo.servo import Servo
from hal.servo.servo_thread import ServoThread

pytestmark = pytest.mark.integration

FOLDED = np.array([0.0, 0.0, -0.005, -0.074, 0.0, 0.0])
QUICK = Parking(q=FOLDED, speed_rad_s=3.0)
LEISURELY = Parking(q=FOLDED, speed_rad_s=0.05)


@contextmanager
def ticking(guard: Guard | None = None, q: np.ndarray | None = None) -> Iterator[tuple[Servo, MockArm]]:
    clock = WallClock()
    arm = MockArm(clock, q=q)
    servo = Servo(arm, clock, heartbeat_timeout_s=5.0, guard=guard)
    servo.connect()
    with ServoThread(servo, clock):
        yield servo, arm
    servo.disconnect()


def after_moving(servo: Servo, act: Callable[[Event], None]) -> Event:
    """Return an event for `park`'s `abort`, which is polled, and which acts once the arm moves."""

    class Acting(Event):
        acted = False

        def wait(self, timeout: float | None = None) -> bool:
            if not self.acted and servo.status().trajectory_time_s > 0.1:
                self.acted = True
                act(self)
            return super().wait(timeout)

    return Acting()


def test_the_arm_is_folded_slowly_and_progress_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="hal.parking"), ticking(Guard()) as (servo, arm):
        servo.claim("a client")
        assert park(servo, QUICK, Event())
        assert arm.read_state().q[: z1.N_ARM] == pytest.approx(FOLDED, abs=1e-2)
    assert "parking: 0 of" in caplog.text
    assert caplog.records[-1].getMessage() == "parked"


def test_an_arm_with_an_object_in_the_gripper_is_not_parked(caplog: pytest.LogCaptureFixture) -> None:
    with ticking() as (servo, arm):
        arm.offset[z1.N_ARM] = -0.02  # an object keeps the jaws open: 2.6 Nm
        while abs(servo.read_state().tau[z1.N_ARM]) < 1.0:
            Event().wait(0.01)
        q = servo.status().q_command
        assert not park(servo, QUICK, Event())
        assert servo.status().q_command == pytest.approx(q)
    assert "the gripper holds an object" in caplog.text


def test_a_stopped_arm_is_not_parked(caplog: pytest.LogCaptureFixture) -> None:
    with ticking() as (servo, _):
        servo.stop("the button")
        assert not park(servo, QUICK, Event())
        assert servo.status().q_command[:6] == pytest.approx(z1.Q_HOME)
        while servo.status().mode is not ServoMode.STOPPED:  # the button may be pressed before the first tick
            Event().wait(0.01)
    assert "not parked: servo: the arm is stopped (the button)" in caplog.text


def test_a_stop_ends_the_parking(caplog: pytest.LogCaptureFixture) -> None:
    with ticking() as (servo, _):
        assert not park(servo, LEISURELY, after_moving(servo, lambda _: servo.stop("a hand came near")))
        while servo.status().mode is not ServoMode.STOPPED:
            Event().wait(0.01)
    assert "a hand came near" in caplog.text


def test_the_operator_can_abort_the_parking(caplog: pytest.LogCaptureFixture) -> None:
    with ticking() as (servo, _):
        assert not park(servo, LEISURELY, after_moving(servo, Event.set))
    assert "parking aborted by the operator" in caplog.text


def test_where_the_guard_forbids_the_straight_path_it_parks_by_way_of_home(caplog: pytest.LogCaptureFixture) -> None:
    """From this pose the straight path to the folded one is in self-collision."""
    low = np.array([0.95, 2.1, -0.92, 0.81, -1.13, -2.2, -0.5])
    guard = Guard()
    assert guard.find_violation(low[None], np.append(z1.Q_HOME, 0.0)) is None
    ratio = np.linspace(0.0, 1.0, 100)[:, None]
    assert guard.find_violation(low + ratio * (np.append(FOLDED, -0.5) - low), low) is not None
    with caplog.at_level(logging.INFO, logger="hal.parking"), ticking(guard, low) as (servo, arm):
        assert park(servo, QUICK, Event())
        assert arm.read_state().q[: z1.N_ARM] == pytest.approx(FOLDED, abs=1e-2)
    assert "parking by way of home" in caplog.text
