"""The setpoint generator alone: every change of motion starts at the last command."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base.messages import ServoMode
from hal.base.z1 import CONTROL_PERIOD_S, N_ARM
from hal.servo.limits import ServoLimits
from hal.servo.setpoint_generator import JointCommand, SetpointGenerator
from hal.servo.trajectory_buffer import TrajectoryBuffer, start_buffer
from tests.support.hal.servo_bench import START, STEP, move

LIMITS = ServoLimits()


class Driver:
    """A generator whose commands pass unclipped, with all of them recorded."""

    def __init__(self) -> None:
        self.generator = SetpointGenerator(LIMITS, START)
        self.q = [START]

    def apply(self, command: JointCommand) -> None:
        self.generator.update_last_command(command.q, command.dq)
        self.q.append(command.q)

    def play(self, trajectory: TrajectoryBuffer, duration_s: float) -> None:
        for _ in range(round(duration_s / CONTROL_PERIOD_S)):
            self.apply(self.generator.play(trajectory))

    def rest(self) -> None:
        while self.generator.mode is ServoMode.BRAKING:
            self.apply(self.generator.brake_or_hold())

    def max_acceleration(self) -> float:
        return float(np.abs(np.diff(self.q, n=2, axis=0)).max() / CONTROL_PERIOD_S**2)


def test_it_holds_its_initial_position() -> None:
    driver = Driver()
    for _ in range(10):
        driver.apply(driver.generator.brake_or_hold())
    assert driver.generator.mode is ServoMode.HOLDING
    assert (np.array(driver.q) == START).all()


def test_a_trajectory_is_played_to_its_end_and_held() -> None:
    driver, trajectory = Driver(), start_buffer(move(), LIMITS)
    driver.generator.begin(trajectory)
    driver.play(trajectory, 1.002)
    assert driver.generator.finished
    assert driver.generator.mode is ServoMode.HOLDING
    assert driver.q[-1] == pytest.approx(START + STEP)


def test_an_incomplete_buffer_has_an_underrun_at_its_end_only() -> None:
    driver, trajectory = Driver(), start_buffer(move(until_s=0.1), LIMITS)
    driver.generator.begin(trajectory)
    driver.play(trajectory, 0.1)
    assert not driver.generator.has_underrun(trajectory)
    driver.play(trajectory, CONTROL_PERIOD_S)
    assert driver.generator.has_underrun(trajectory)


@pytest.mark.parametrize("on_path", [True, False])
def test_braking_starts_at_the_last_command_and_ends_at_rest(on_path: bool) -> None:
    driver, trajectory = Driver(), start_buffer(move(), LIMITS)
    driver.generator.begin(trajectory)
    driver.play(trajectory, 0.5)
    driver.generator.brake("test", trajectory if on_path else None)
    assert (driver.generator.mode, driver.generator.reason) == (ServoMode.BRAKING, "test")
    driver.rest()
    assert driver.generator.mode is ServoMode.HOLDING
    assert driver.max_acceleration() < 2.0 * LIMITS.ddq_max.max()
    # Off the path each joint stops for itself; on it all joints have made the same part of the step.
    progress = ((driver.q[-1] - START) / STEP)[:N_ARM]
    assert (np.ptp(progress) < 1e-6) == on_path


def test_the_predicted_rest_position_is_where_braking_ends() -> None:
    driver = Driver()
    for _ in range(100):
        driver.apply(driver.generator.track(START + STEP))
    predicted = driver.generator.predict_rest_position()
    driver.generator.brake("test")
    driver.rest()
    assert driver.q[-1] == pytest.approx(predicted, abs=1e-9)


def test_yielding_moves_the_hold_to_the_measured_arm_and_keeps_the_grip() -> None:
    driver = Driver()
    measured = START.copy()
    measured[0] += 0.05
    measured[1] += 0.005  # below the threshold: an ordinary tracking error
    measured[N_ARM] += 0.2
    driver.generator.yield_to_measured(measured)
    for _ in range(500):
        driver.apply(driver.generator.brake_or_hold())
    expected = START.copy()
    expected[0] = measured[0]
    assert driver.q[-1] == pytest.approx(expected, abs=1e-12)
    assert driver.max_acceleration() < 2.0 * LIMITS.ddq_max.max()


def test_a_skipped_trajectory_counts_as_taken_and_not_finished() -> None:
    generator = SetpointGenerator(LIMITS, START)
    generator.skip(7, "cancelled")
    assert (generator.trajectory_id, generator.finished, generator.reason) == (7, False, "cancelled")
