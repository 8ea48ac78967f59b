"""Bounds of the numbers and texts in messages: nothing that a stranger may send is computed with unchecked."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base.errors import InvalidMessageError
from hal.base.messages import MAX_CHUNK_POINTS, MAX_TEXT, ArmSetpoint, ArmState, Intrinsics, TrajectoryChunk
from tests.support.errors import raises

ZERO = np.zeros(7)


def chunk(**changes) -> TrajectoryChunk:
    values = {"trajectory_id": 1, "t_s": [0.0, 0.1], "q": np.zeros((2, 7)), "dq": np.zeros((2, 7))}
    return TrajectoryChunk(**(values | changes))


def test_ordinary_messages_are_accepted() -> None:
    chunk()
    ArmState(stamp_s=1.7e9, q=ZERO, dq=ZERO - 3.0, tau=ZERO + 60.0, faults=("overheat",))


@pytest.mark.parametrize("value", [1e7, -1e18, 1e300])
def test_a_number_of_an_array_out_of_its_range_is_rejected(value: float) -> None:
    q = ZERO.copy()
    q[3] = value
    with raises(InvalidMessageError, "out_of_range"):
        ArmSetpoint(q=q, dq=ZERO)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_rejected(value: float) -> None:
    for wrong in ({"dq": ZERO + value}, {"stamp_s": value}):
        with raises(InvalidMessageError, "not_finite"):
            ArmState(**({"stamp_s": 1.0, "q": ZERO, "dq": ZERO, "tau": ZERO} | wrong))


@pytest.mark.parametrize("stamp_s", [1e12, -1e300])
def test_a_time_out_of_its_range_is_rejected(stamp_s: float) -> None:
    with raises(InvalidMessageError, "out_of_range"):
        ArmState(stamp_s=stamp_s, q=ZERO, dq=ZERO, tau=ZERO)


def test_a_text_that_is_too_long_is_rejected() -> None:
    with raises(InvalidMessageError, "out_of_range"):
        ArmState(stamp_s=1.0, q=ZERO, dq=ZERO, tau=ZERO, faults=("x" * (MAX_TEXT + 1),))


@pytest.mark.parametrize("number", [0, -5, 2**53 + 1, 10**400], ids=["0", "negative", "54 bits", "400 digits"])
def test_a_number_of_a_trajectory_out_of_its_range_is_rejected(number: int) -> None:
    with raises(InvalidMessageError, "out_of_range"):
        chunk(trajectory_id=number)


@pytest.mark.parametrize(
    "t_s", [[0.1, 0.1], [0.1, 0.0], [-1.0, 0.0], [0.0, 1e-300]], ids=["equal", "back", "negative", "denormal"]
)
def test_times_that_do_not_increase_by_a_computable_step_are_rejected(t_s: list[float]) -> None:
    with raises(InvalidMessageError, "invalid_times"):
        chunk(t_s=t_s)


@pytest.mark.parametrize("n", [0, MAX_CHUNK_POINTS + 1])
def test_a_chunk_without_points_or_with_too_many_is_rejected(n: int) -> None:
    with raises(InvalidMessageError, "invalid_times"):
        chunk(t_s=np.arange(n) * 0.001, q=np.zeros((n, 7)), dq=np.zeros((n, 7)))


def test_a_size_of_an_image_out_of_its_range_is_rejected() -> None:
    with raises(InvalidMessageError, "out_of_range"):
        Intrinsics(width=2**60, height=480, fx=400.0, fy=400.0, cx=320.0, cy=240.0)
