"""The setpoint generator alone: every change of motion starts at the last command."""

from __future__ import annotations

from collections.abc import Callable

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

    def __init__(self, find_violation: Callable[[np.ndarray], str] = lambda _: "") -> None:
        self.generator = SetpointGenerator(LIMITS, START, find_violation)
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
    driver.generator.begin(trajectory, START)
    driver.play(trajectory, 1.002)
    assert driver.generator.finished
    assert driver.generator.mode is ServoMode.HOLDING
    assert driver.q[-1] == pytest.approx(START + STEP)


def test_an_incomplete_buffer_has_an_underrun_while_a_stop_still_ends_on_it() -> None:
    driver, trajectory = Driver(), start_buffer(move(until_s=0.4), LIMITS)
    driver.generator.begin(trajectory, START)
    while not driver.generator.has_underrun(trajectory):
        driver.apply(driver.generator.play(trajectory))
    assert 0.25 < driver.generator.trajectory_time_s < 0.4
    driver.generator.brake("test")
    driver.rest()
    progress = (driver.q[-1] - START) / STEP
    assert np.ptp(progress) < 1e-6
    assert progress[0] <= (trajectory.q[-1, 0] - START[0]) / STEP[0] + 1e-9


def test_braking_starts_at_the_last_command_and_ends_at_rest_on_the_path() -> None:
    driver, trajectory = Driver(), start_buffer(move(), LIMITS)
    driver.generator.begin(trajectory, START)
    driver.play(trajectory, 0.5)
    driver.generator.brake("test")
    assert (driver.generator.mode, driver.generator.reason) == (ServoMode.BRAKING, "test")
    driver.rest()
    assert driver.generator.mode is ServoMode.HOLDING
    assert driver.max_acceleration() < 2.0 * LIMITS.ddq_max.max()
    assert np.ptp((driver.q[-1] - START) / STEP) < 1e-6, "all joints have made the same part of the step"


def test_a_step_is_only_taken_while_the_stop_from_it_is_allowed() -> None:
    """A wall in joint 1 that appears in the middle of the motion: the arm stops before it, as was known before."""
    wall = START[0] + 0.3

    def find_violation(q: np.ndarray) -> str:
        return "meets the wall" if (q[:, 0] > wall).any() else ""

    driver = Driver(find_violation)
    while driver.generator.mode is not ServoMode.BRAKING:
        driver.apply(driver.generator.track(START + STEP))
    assert "the motion to the setpoint meets the wall" in driver.generator.reason
    driver.rest()
    q = np.array(driver.q)
    assert wall - 0.05 < q[-1, 0] <= wall
    jerk = np.abs(np.diff(q, n=3, axis=0)) / CONTROL_PERIOD_S**3
    assert (jerk <= 1.01 * LIMITS.brake_dddq_max).all()


def test_a_trajectory_that_starts_elsewhere_is_begun_by_a_motion_to_its_start() -> None:
    driver, trajectory = Driver(), start_buffer(move(start=START + 0.04), LIMITS)
    driver.generator.begin(trajectory, START)
    driver.play(trajectory, 2.0)
    assert driver.generator.finished
    assert driver.q[-1] == pytest.approx(START + 0.04 + STEP)
    assert driver.max_acceleration() <= 1.05 * LIMITS.ddq_max.max()


def test_a_squeezing_gripper_begins_where_it_is() -> None:
    driver = Driver()
    squeezed = START.copy()
    squeezed[N_ARM] -= 0.3
    trajectory = start_buffer(move(start=squeezed), LIMITS)
    driver.generator.begin(trajectory, squeezed)
    command = driver.generator.play(trajectory)
    assert command.q == pytest.approx(squeezed)
    assert driver.generator.trajectory_time_s == 0.0


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
