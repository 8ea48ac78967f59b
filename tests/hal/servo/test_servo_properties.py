"""Property: no sequence of legal commands drives a setpoint out of the guard's space or beyond the limits."""

from __future__ import annotations

import logging
import os

import numpy as np
import pytest

from hal.base.messages import ServoMode
from hal.base.z1 import CONTROL_PERIOD_S, Q_MAX
from hal.servo.limits import ServoLimits
from tests.support.hal.random_commands import CarelessClient, Violations, check_setpoints, run_sequences

_LOG = logging.getLogger(__name__)
_FEW = 150
_MANY = int(os.environ.get("Z1_SEQUENCES", "100000"))


@pytest.mark.integration
def test_a_few_random_sequences_of_legal_commands_have_no_violation() -> None:
    found, seed = run_sequences(range(_FEW))
    assert found.accepted > _FEW, "most chunks have to be accepted"
    assert found.total == 0, f"first seed with one: {seed}; {found}"


@pytest.mark.slow
@pytest.mark.timeout(0)
def test_many_random_sequences_of_legal_commands_have_no_violation() -> None:
    """100,000 sequences, 36 million setpoints, in about an hour of one core; Z1_SEQUENCES sets another number."""
    total = Violations()
    for first in range(_FEW, _FEW + _MANY, 1000):
        found, seed = run_sequences(range(first, min(first + 1000, _FEW + _MANY)))
        total += found
        _LOG.info("%s", total)
        assert total.total == 0, f"first seed with one: {seed}; {total}"


# --- The oracle sees what it has to see -----------------------------------------------------------------------------


@pytest.fixture
def client() -> CarelessClient:
    made = CarelessClient(np.random.default_rng(3))
    made.run_sequence()
    assert check_setpoints(made).total == 0
    return made


def shift(client: CarelessClient, joint: int, offsets: list[float]) -> Violations:
    """Return the violations after `offsets` [rad] have been added to a joint's first setpoints, of no stop."""
    sent = [q.copy() for q in client.arm.sent]
    for q, offset in zip(sent, offsets, strict=False):
        q[joint] += offset
    client.arm.sent[:] = sent
    client.modes[:] = [ServoMode.TRACKING] * len(client.modes)
    return check_setpoints(client)


def test_the_oracle_counts_a_jump_of_the_jerk(client: CarelessClient) -> None:
    jerk = 1.1 * ServoLimits().dddq_max[5]
    found = shift(client, 5, [jerk * CONTROL_PERIOD_S**3 * (-1) ** i for i in range(4)])
    assert found.beyond_jerk > 0
    assert found.too_fast == found.outside_guard == 0


def test_the_oracle_counts_a_jump_of_the_acceleration_and_of_the_speed(client: CarelessClient) -> None:
    limits = ServoLimits()
    found = shift(client, 0, [1.1 * limits.ddq_max[0] * CONTROL_PERIOD_S**2])
    assert found.beyond_acceleration > 0
    assert shift(client, 0, [1.1 * limits.dq_max[0] * CONTROL_PERIOD_S]).too_fast > 0


def test_the_oracle_counts_setpoints_beyond_joint_limits_and_guard(client: CarelessClient) -> None:
    found = shift(client, 1, [Q_MAX[1]])
    assert found.outside_joint_limits == 1
    below = [q.copy() for q in client.arm.sent]
    below[0][:] = [0.0, 2.2, -0.9, 0.3, 0.0, 1.57, -0.5]  # the gripper under the table
    client.arm.sent[:] = below
    assert check_setpoints(client).outside_guard >= 1
