"""The motor board's wire protocol, byte by byte."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from hal.z1_protocol import motor_board
from hal.z1_protocol.records import JointCommands, JointStates, ProtocolError
from tests.support.errors import raises


def joints(n: int, value: float) -> np.ndarray:
    return np.full(n, value)


def commands(n: int) -> JointCommands:
    return JointCommands(
        q=joints(n, -2.0), dq=joints(n, 0.5), tau=joints(n, 1.0), kp=joints(n, 20.0), kd=joints(n, 2000.0)
    )


def states(n: int) -> JointStates:
    motors = {name: np.zeros((n, 2), dtype=np.uint8) for name in ("error", "link")}
    return JointStates(
        q=joints(n, -2.0),
        dq=joints(n, 0.5),
        ddq=joints(n, 0.0),
        tau=joints(n, 1.0),
        temperature_c=np.full((n, 2), 25, dtype=np.int8),
        **motors,
    )


COMMAND_RECORD = bytes.fromhex("0000803f 0000003f 000000c0 0000a041 0000fa44")
STATE_RECORD = bytes.fromhex("0000803f 0000003f 00000000 000000c0 19 00 00 19 00 00")


@pytest.mark.parametrize(("n", "size"), [(7, 140), (6, 120)])
def test_commands_are_the_golden_bytes_in_both_directions(n: int, size: int) -> None:
    data = motor_board.encode_command(commands(n))
    assert data == COMMAND_RECORD * n
    assert len(data) == size
    read = motor_board.decode_command(data)
    for name in ("q", "dq", "tau", "kp", "kd"):
        assert getattr(read, name) == pytest.approx(getattr(commands(n), name))


@pytest.mark.parametrize(("n", "size"), [(7, 154), (6, 132)])
def test_states_are_the_golden_bytes_in_both_directions(n: int, size: int) -> None:
    data = motor_board.encode_state(states(n))
    assert data == STATE_RECORD * n
    assert len(data) == size
    read = motor_board.decode_state(data)
    assert read.q == pytest.approx(joints(n, -2.0))
    assert (read.temperature_c == 25).all()


def test_the_old_format_without_motor_records_is_accepted() -> None:
    read = motor_board.decode_state(STATE_RECORD[:16] * 7)
    assert read.q == pytest.approx(joints(7, -2.0))
    assert read.tau == pytest.approx(joints(7, 1.0))
    assert not read.error.any()
    assert not read.link.any()


def test_the_self_check_is_the_golden_bytes_in_both_directions() -> None:
    assert motor_board.SELF_CHECK == b"\x02"
    assert motor_board.encode_self_check([1] * 8) == bytes.fromhex("20 08 01 01 01 01 01 01 01 01")
    assert motor_board.decode_self_check(bytes.fromhex("20 07 01 01 00 01 01 01 01")) == (1, 1, 0, 1, 1, 1, 1)


@pytest.mark.parametrize(
    "data", [b"", b"\x20", b"\x20\x08", b"\x20\x08" + bytes(9), b"\x21\x07" + bytes(7), b"\x20\x00"]
)
def test_an_invalid_self_check_is_rejected(data: bytes) -> None:
    with raises(ProtocolError, "self_check"):
        motor_board.decode_self_check(data)


@pytest.mark.parametrize("size", [0, 1, 119, 121, 139, 141, 147, 154, 1500])
def test_a_command_of_a_wrong_size_is_rejected(size: int) -> None:
    with raises(ProtocolError, "wrong_size"):
        motor_board.decode_command(bytes(size))


@pytest.mark.parametrize("size", [0, 1, 95, 111, 131, 140, 153, 155, 208, 1500])
def test_a_state_of_a_wrong_size_is_rejected(size: int) -> None:
    with raises(ProtocolError, "wrong_size"):
        motor_board.decode_state(bytes(size))


def test_values_that_are_not_finite_are_rejected() -> None:
    nan = bytes.fromhex("0000c07f")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with raises(ProtocolError, "not_finite"):
            motor_board.decode_command(nan + motor_board.encode_command(commands(7))[4:])
        with raises(ProtocolError, "implausible_value"):
            motor_board.decode_state(nan + motor_board.encode_state(states(7))[4:])
    with raises(ProtocolError, "not_finite"):
        motor_board.encode_command(JointCommands(q=joints(7, np.inf)))


@pytest.mark.integration
def test_random_datagrams_are_decoded_or_rejected_and_nothing_else() -> None:
    rng = np.random.default_rng(6)
    outcomes = {"read": 0, "rejected": 0}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for i in range(10_000):
            sizes = (
                *motor_board.COMMAND_SIZES,
                *motor_board.STATE_SIZES,
                *motor_board.OLD_STATE_SIZES,
                int(rng.integers(0, 300)),
            )
            data = rng.bytes(sizes[i % len(sizes)])
            for read in (motor_board.decode_command, motor_board.decode_state, motor_board.decode_self_check):
                try:
                    read(data)
                    outcomes["read"] += 1
                except ProtocolError:
                    outcomes["rejected"] += 1
    assert sum(outcomes.values()) == 30_000
    assert min(outcomes.values()) > 0
