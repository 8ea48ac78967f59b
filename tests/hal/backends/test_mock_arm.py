"""The mock arm follows its setpoints, and fails on request."""

from __future__ import annotations

import numpy as np
import pytest

from hal.backends.mock_arm import MockArm, make_rig
from hal.base.clock import ManualClock
from hal.base.errors import CommandRejectedError, HalTimeoutError
from hal.base.messages import ArmSetpoint
from hal.base.z1 import KP, N_JOINTS, Q_MAX, Q_MIN, TAU_MAX
from tests.support.errors import raises

MIDDLE = (Q_MIN + Q_MAX) / 2
ZERO = np.zeros(N_JOINTS)


@pytest.fixture
def arm() -> MockArm:
    arm = MockArm(ManualClock(), q=MIDDLE, time_constant_s=0.05)
    arm.connect()
    return arm


def let_pass(arm: MockArm, duration_s: float) -> None:
    arm.clock.sleep_until(arm.clock.now_s() + duration_s)


def test_it_follows_first_order(arm: MockArm) -> None:
    arm.send(ArmSetpoint(q=MIDDLE + 0.1, dq=ZERO))
    let_pass(arm, 0.05)
    state = arm.read_state()
    assert state.q - MIDDLE == pytest.approx(np.full(N_JOINTS, 0.1 * (1 - np.exp(-1))))
    assert state.tau == pytest.approx(np.minimum(KP * (MIDDLE + 0.1 - state.q), TAU_MAX))


def test_it_settles_at_a_distance_from_its_setpoint_with_an_offset(arm: MockArm) -> None:
    arm.offset[1] = 0.2
    let_pass(arm, 5.0)
    assert arm.read_state().q - MIDDLE == pytest.approx(np.eye(N_JOINTS)[1] * 0.2)


def test_its_faults_are_those_injected_until_cleared(arm: MockArm) -> None:
    arm.inject_fault("overheat joint 2", "CRC")
    assert arm.read_state().faults == ("overheat joint 2", "CRC")
    arm.inject_fault()
    assert arm.read_state().faults == ()


def test_frozen_it_repeats_its_last_state_and_then_times_out(arm: MockArm) -> None:
    arm.freeze()
    arm.send(ArmSetpoint(q=MIDDLE + 0.1, dq=ZERO))
    let_pass(arm, 0.09)
    assert arm.read_state().q == pytest.approx(MIDDLE)
    assert arm.read_state().stamp_s == 0.0
    let_pass(arm, 0.02)
    with raises(HalTimeoutError, "stale_state"):
        arm.read_state()
    arm.thaw()
    assert (arm.read_state().q > MIDDLE + 0.05).all()


def test_it_loses_or_rejects_commands_on_request(arm: MockArm) -> None:
    arm.drop_commands = True
    assert arm.send(ArmSetpoint(q=MIDDLE + 0.1, dq=ZERO)).q == pytest.approx(MIDDLE + 0.1)
    let_pass(arm, 1.0)
    assert arm.read_state().q == pytest.approx(MIDDLE)
    arm.reject_commands = True
    with raises(CommandRejectedError, "command_rejected"):
        arm.send(ArmSetpoint(q=MIDDLE, dq=ZERO))


def test_a_mock_rig_holds_devices_of_one_clock() -> None:
    rig = make_rig(scene=None)
    rig.arm.connect()
    rig.camera.connect()
    now_s = rig.clock.now_s()
    assert rig.call_every_tick is None
    assert abs(rig.arm.read_state().stamp_s - now_s) < 5.0
    assert abs(rig.camera.wait_for_frame(2.0).stamp_s - now_s) < 5.0
