"""Limits between the servo and the arm."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base.errors import InvalidMessageError
from hal.base.z1 import CONTROL_PERIOD_S, DDQ_MAX, DQ_MAX, KP, N_ARM, N_JOINTS, Q_MAX, Q_MIN
from hal.servo.limits import (
    SPEED_TOLERANCE,
    ClippedSetpoint,
    OverloadDetector,
    ServoLimits,
    clip_setpoint,
    compute_servo_torque,
    find_blocked,
)
from tests.support.errors import raises

LIMITS = ServoLimits()
MIDDLE = (Q_MIN + Q_MAX) / 2
ZERO = np.zeros(N_JOINTS)


def clip(
    q: np.ndarray, dq: np.ndarray, q_last: np.ndarray, q_measured: np.ndarray, dq_measured: np.ndarray = ZERO
) -> ClippedSetpoint:
    return clip_setpoint(LIMITS, q, dq, q_command=MIDDLE, q_last=q_last, q_measured=q_measured, dq_measured=dq_measured)


def test_a_setpoint_within_the_limits_is_unchanged() -> None:
    q = MIDDLE + 0.001
    allowed = clip(q, ZERO + 0.5, MIDDLE, MIDDLE)
    assert (allowed.q == q).all()
    assert (allowed.dq == 0.5).all()
    assert not allowed.clipped


def test_a_step_is_no_faster_than_the_joints() -> None:
    allowed = clip(MIDDLE + 0.5, ZERO + 9.0, MIDDLE, MIDDLE)
    assert allowed.q == pytest.approx(MIDDLE + SPEED_TOLERANCE * DQ_MAX * CONTROL_PERIOD_S)
    assert allowed.dq[:N_ARM] == pytest.approx(DQ_MAX[:N_ARM])
    assert allowed.clipped


@pytest.mark.parametrize(("edge", "side"), [(Q_MIN, -1.0), (Q_MAX, 1.0)])
def test_positions_end_at_the_joint_limits(edge: np.ndarray, side: float) -> None:
    allowed = clip(edge + side, ZERO, edge - side * 0.001, edge)
    assert allowed.q == pytest.approx(edge)


def test_a_setpoint_clipped_at_a_joint_limit_has_no_velocity() -> None:
    desired = MIDDLE.copy()
    desired[4] = Q_MAX[4] + 0.001
    allowed = clip(desired, ZERO + 1.0, desired, desired)
    assert allowed.dq.tolist() == [1, 1, 1, 1, 0, 1, 1]


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_gripper_leads_its_measurement_by_the_grip_torque_at_most(side: float) -> None:
    desired = MIDDLE.copy()
    desired[N_ARM] += side * 0.5
    last = MIDDLE.copy()
    last[N_ARM] += side * 0.022
    allowed = clip(desired, ZERO + 1.0, last, MIDDLE)
    assert KP[N_ARM] * (allowed.q - MIDDLE)[N_ARM] == pytest.approx(side * 3.0)
    assert allowed.dq[N_ARM] == 0.0
    assert not allowed.clipped


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_moving_jaw_may_be_led_further_by_the_distance_of_its_latency(side: float) -> None:
    desired, moving = MIDDLE.copy(), ZERO.copy()
    desired[N_ARM] += side * 0.06
    moving[N_ARM] = side * 2.0
    ahead = clip(desired, moving, desired, MIDDLE, moving)
    assert ahead.q[N_ARM] == desired[N_ARM]
    assert ahead.dq[N_ARM] == side * 2.0
    behind = clip(desired, moving, desired, MIDDLE, -moving)  # against its motion the torque alone leads it
    at_most = SPEED_TOLERANCE * DQ_MAX[N_ARM] * CONTROL_PERIOD_S
    assert side * (behind.q - MIDDLE)[N_ARM] == pytest.approx(max(3.0 / KP[N_ARM], 0.06 - at_most))


def test_a_measured_jaw_speed_beyond_its_maximum_extends_the_lead_no_further() -> None:
    desired, moving = MIDDLE.copy(), ZERO.copy()
    desired[N_ARM] += 0.5
    moving[N_ARM] = 99.0
    last = MIDDLE.copy()
    last[N_ARM] += 0.5
    lead = (clip(desired, ZERO, last, MIDDLE, moving).q - MIDDLE)[N_ARM]
    max_lead = 3.0 / KP[N_ARM] + DQ_MAX[N_ARM] * LIMITS.gripper_lag_s
    assert lead == pytest.approx(max(max_lead, 0.5 - SPEED_TOLERANCE * DQ_MAX[N_ARM] * CONTROL_PERIOD_S))


def test_an_arm_outside_its_limits_returns_at_no_more_than_the_joints_speed() -> None:
    outside = Q_MAX + 0.1
    allowed = clip(outside, ZERO, outside, outside)
    assert allowed.q[:N_ARM] == pytest.approx((outside - SPEED_TOLERANCE * DQ_MAX * CONTROL_PERIOD_S)[:N_ARM])


@pytest.mark.parametrize("offset", [-0.0003, 0.0])
def test_a_joint_that_rests_on_or_just_beyond_its_limit_stays_there_and_is_not_clipped(offset: float) -> None:
    q = MIDDLE.copy()
    q[1] = Q_MIN[1] + offset
    allowed = clip_setpoint(LIMITS, q, ZERO, q_command=q, q_last=q, q_measured=q, dq_measured=ZERO)
    assert allowed.q == pytest.approx(q, abs=1e-12)
    assert not allowed.clipped
    further = q - 0.001
    allowed = clip_setpoint(LIMITS, further, ZERO, q_command=q, q_last=q, q_measured=q, dq_measured=ZERO)
    assert allowed.q[1] == pytest.approx(q[1], abs=1e-12)
    assert allowed.clipped


def test_brakes_too_weak_for_full_speed_are_rejected() -> None:
    with raises(InvalidMessageError, "invalid_limit"):
        ServoLimits(brake_ddq_max=2.0 * DDQ_MAX)


def test_a_joint_that_does_not_follow_is_named() -> None:
    command = MIDDLE.copy()
    command[3] += 0.31
    assert find_blocked(LIMITS, command, MIDDLE).startswith("joint4 is 0.31 rad from its command")
    command[3] = MIDDLE[3] + 0.29
    command[N_ARM] += 1.0
    assert find_blocked(LIMITS, command, MIDDLE) == ""


def test_a_motor_may_be_at_its_torque_limit_for_a_tenth_of_a_second() -> None:
    detector = OverloadDetector(LIMITS)
    tau = ZERO.copy()
    tau[2] = -30.0
    assert [detector.update(tau, ZERO) for _ in range(50)] == [""] * 50
    assert detector.update(tau, ZERO).startswith("joint3 has been at its torque limit (-30.0 Nm of 29.4) for")


def test_a_command_may_ask_for_more_than_the_maximum_torque_for_a_tenth_of_a_second() -> None:
    detector = OverloadDetector(LIMITS)
    command = MIDDLE.copy()
    command[0] += 0.048
    requested = compute_servo_torque(command, MIDDLE)
    assert requested[0] == pytest.approx(0.048 * 640)
    assert [detector.update(ZERO, requested) for _ in range(50)] == [""] * 50
    assert "joint1 does not follow: its command has asked for 30.7 Nm (allowed 30.0)" in detector.update(
        ZERO, requested
    )


def test_the_gripper_may_stay_at_its_maximum_torque() -> None:
    detector = OverloadDetector(LIMITS)
    requested = ZERO.copy()
    requested[N_ARM] = 60.0
    assert [detector.update(requested, requested) for _ in range(100)] == [""] * 100


def test_short_peaks_of_different_motors_do_not_add_up() -> None:
    detector = OverloadDetector(LIMITS)
    for tick in range(300):
        tau = ZERO.copy()
        tau[tick // 40 % 2] = 60.0
        assert detector.update(tau, ZERO) == ""


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ({"grip_torque_nm": -1.0}, "invalid_limit"),
        ({"q_min": Q_MAX}, "invalid_limit"),
        ({"dq_max": [1, 2]}, "wrong_shape"),
    ],
)
def test_invalid_limits_are_rejected(options: dict, code: str) -> None:
    with raises(InvalidMessageError, code):
        ServoLimits(**options)
