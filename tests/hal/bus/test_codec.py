"""The codec returns every message unchanged, and rejects everything else."""

from __future__ import annotations

import dataclasses
import inspect

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hal.base.messages
from hal.base.errors import InvalidMessageError
from hal.base.messages import (
    ArmSetpoint,
    ArmState,
    Intrinsics,
    RgbdFrame,
    ServoHealth,
    ServoMode,
    ServoStatus,
    TrajectoryChunk,
)
from hal.bus.codec import MAX_BYTES, Hello, decode, decode_text, encode, encode_into
from tests.support.errors import raises

RNG = np.random.default_rng(3)
INTRINSICS = Intrinsics(width=6, height=4, fx=380.5, fy=381.0, cx=2.5, cy=1.75)
IMAGES = {
    "colour": RNG.integers(0, 256, (4, 6, 3)),
    "depth_m": RNG.uniform(0, 1, (4, 6)).astype(np.float32),
    "intrinsics": INTRINSICS,
    "stamp_s": 12.25,
    "sequence": 2**40,
}
STATUS = ServoStatus(
    stamp_s=3.5,
    mode=ServoMode.BRAKING,
    reason="kein Herzschlag – 0,1 s",
    owner="runtime-1f",
    trajectory_id=7,
    trajectory_time_s=0.25,
    buffered_s=0.125,
    finished=False,
    q_command=RNG.normal(size=7),
    ticks=12345,
    overruns=2,
    period_ms_p50=2.0,
    period_ms_p999=2.5,
)
SAMPLES = [
    INTRINSICS,
    RgbdFrame(**IMAGES),
    RgbdFrame(**IMAGES, ground_truth_mask=RNG.uniform(size=(4, 6)) > 0.5),
    ArmState(stamp_s=1.5, q=RNG.normal(size=7), dq=RNG.normal(size=7), tau=RNG.normal(size=7), faults=("hot", "ü")),
    ArmSetpoint(q=RNG.normal(size=7), dq=RNG.normal(size=7)),
    TrajectoryChunk(
        trajectory_id=4, t_s=np.arange(5) * 0.02, q=RNG.normal(size=(5, 7)), dq=RNG.normal(size=(5, 7)), final=True
    ),
    STATUS,
    ServoHealth(
        stamp_s=3.5,
        mode=ServoMode.STOPPED,
        faults=("hot",),
        rate_hz=499.5,
        period_ms_p50=2.0,
        period_ms_p99=2.25,
        period_ms_p999=2.5,
        period_ms_max=30.0,
        ticks=12345,
        overruns=2,
        owner="",
        command_age_s=0.0,
        real_time=("SCHED_FIFO",),
    ),
    Hello(robot="z1", versions=("protocol=1",), now_s=2.5),
]
ENCODED = [encode(sample) for sample in SAMPLES]


def _same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b)
    return type(a) is type(b) and a == b


def _envelope(header: object, body: bytes = b"") -> bytes:
    packed = bytes(msgpack.packb(header) or b"")
    return b"Z1\x01\x00" + len(packed).to_bytes(4, "little") + packed + body


def _with(sample: object, **changes: object) -> bytes:
    """Encode `sample`, then change plain fields of its header."""
    data = encode(sample)
    end = 8 + int.from_bytes(data[4:8], "little")
    name, plain = msgpack.unpackb(data[8:end])
    return _envelope([name, {**plain, **changes}], data[end:])


def test_there_is_a_sample_of_every_message_type():
    types = {
        kind for _, kind in inspect.getmembers(hal.base.messages, inspect.isclass) if dataclasses.is_dataclass(kind)
    }
    assert types | {Hello} == {type(sample) for sample in SAMPLES}


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda sample: type(sample).__name__)
def test_a_message_is_decoded_as_it_was_encoded(sample):
    back = decode(encode(sample), type(sample))
    assert type(back) is type(sample)
    for field in dataclasses.fields(sample):
        assert _same(getattr(sample, field.name), getattr(back, field.name)), field.name


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda sample: type(sample).__name__)
def test_encoding_into_a_buffer_of_any_length_gives_the_same_bytes(sample):
    for buffer in (bytearray(), bytearray(b"x" * 5000)):
        encode_into(sample, buffer)
        assert bytes(buffer) == encode(sample)


def test_decoded_arrays_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):  # NumPy's text: it has no type of its own
        decode(encode(STATUS)).q_command[0] = 1.0


def test_object_arrays_are_rejected():
    state = ArmState(stamp_s=0.0, q=np.zeros(7), dq=np.zeros(7), tau=np.zeros(7))
    object.__setattr__(state, "q", np.array([object()] * 7))
    with raises(InvalidMessageError, "invalid_dtype"):
        encode(state)


def test_an_object_of_another_type_is_not_encoded():
    with pytest.raises(TypeError):
        encode({"q": 1})


def test_a_message_of_another_type_than_expected_is_rejected():
    with raises(InvalidMessageError, "unknown_type"):
        decode(encode(ArmSetpoint(q=np.zeros(7), dq=np.zeros(7))), ArmState)


def test_another_version_is_rejected():
    data = bytearray(ENCODED[0])
    data[2] = 9
    with raises(InvalidMessageError, "other_version"):
        decode(bytes(data))


def test_an_oversized_payload_is_rejected_before_it_is_parsed():
    with raises(InvalidMessageError, "invalid_length"):
        decode(bytes(MAX_BYTES + 1))


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"", "invalid_length"),
        (b"hello, world", "invalid_magic"),
        (_envelope(["os.system", {"command": "true"}]), "unknown_type"),
        (_envelope(["ArmSetpoint", {}]), "invalid_fields"),
        (_envelope({"type": "ArmSetpoint"}), "invalid_header"),
        (_envelope(["ArmSetpoint", {"q": [7], "dq": [2**62]}], bytes(56)), "invalid_array"),
        (_envelope(["ArmSetpoint", {"q": [7], "dq": [-7]}], bytes(112)), "invalid_array"),
        (_envelope(["ArmSetpoint", {"q": [0, 2**26, 2**26, 2**26], "dq": [7]}], bytes(56)), "invalid_array"),
        (_envelope(["ArmSetpoint", {"q": [7], "dq": [7]}], bytes(111)), "invalid_array"),
        (_envelope(["ArmSetpoint", {"q": [7], "dq": [7]}], bytes(113)), "invalid_length"),
        (_envelope(["ArmSetpoint", {"q": [6], "dq": [7]}], bytes(104)), "wrong_shape"),
        (_envelope(["ArmSetpoint", {"q": [7], "dq": [7]}], bytes(48) + np.float64(np.nan).tobytes() * 8), "not_finite"),
        (_with(STATUS, mode="dancing"), "invalid_field"),
        (_with(STATUS, mode=["holding"]), "invalid_field"),
        (_with(STATUS, ticks=1.0), "invalid_field"),
        (_with(STATUS, ticks=True), "invalid_field"),
        (_with(STATUS, finished=1), "invalid_field"),
        (_with(STATUS, stamp_s=float("inf")), "invalid_field"),
        (_with(STATUS, q_command=None), "invalid_array"),
        (_with(SAMPLES[1], intrinsics={"width": 6}), "invalid_field"),
        (_with(SAMPLES[1], intrinsics={**dataclasses.asdict(INTRINSICS), "width": 7}), "wrong_shape"),
        (_with(SAMPLES[3], faults="hot"), "invalid_field"),
        (_with(SAMPLES[3], faults=[1]), "invalid_field"),
        (ENCODED[2][:-1] + b"\x02", "invalid_array"),
        (b"Z1\x01\x00\xff\xff\xff\xff" + bytes(50), "invalid_header"),
    ],
)
def test_each_kind_of_damage_has_its_code(data, code):
    with raises(InvalidMessageError, code):
        decode(data)


def test_the_text_of_an_invalid_field_names_the_field_its_value_and_the_allowed_ones():
    with raises(InvalidMessageError, "invalid_field") as caught:
        decode(_with(STATUS, mode="dancing"))
    assert str(caught.value) == ("codec: ServoStatus.mode is 'dancing' (allowed holding, tracking, braking, stopped).")


def _check_message_or_rejection(data: bytes) -> None:
    try:
        message = decode(data)
    except InvalidMessageError:
        return
    assert type(message) in {type(sample) for sample in SAMPLES}


@given(st.sampled_from(ENCODED), st.data())
def test_a_truncated_message_is_always_rejected(data, draw):
    cut = draw.draw(st.integers(0, len(data) - 1))
    with pytest.raises(InvalidMessageError):
        decode(data[:cut])


@pytest.mark.integration
@given(st.sampled_from(ENCODED), st.data())
def test_mutated_bytes_give_a_message_or_a_rejection(data, draw):
    damaged = bytearray(data)
    for _ in range(draw.draw(st.integers(1, 4))):
        # Most of a message is array: aim at the header half of the time.
        end = draw.draw(st.sampled_from([min(len(data), 120), len(data)]))
        damaged[draw.draw(st.integers(0, end - 1))] = draw.draw(st.integers(0, 255))
    _check_message_or_rejection(bytes(damaged))


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=8) | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


@pytest.mark.integration
@given(st.sampled_from(SAMPLES), st.data())
def test_any_value_in_any_field_gives_a_message_or_a_rejection(sample, draw):
    field = draw.draw(st.sampled_from([field.name for field in dataclasses.fields(sample)]))
    _check_message_or_rejection(_with(sample, **{field: draw.draw(_JSON)}))


@given(st.binary(max_size=200), st.booleans())
def test_arbitrary_bytes_are_rejected(data, framed):
    if framed:
        data = b"Z1\x01\x00" + len(data).to_bytes(4, "little") + data
    with pytest.raises(InvalidMessageError):
        decode(data)


@pytest.mark.parametrize("data", [b"\xff\xfe", b"a" * 2001])
def test_a_text_that_is_too_long_or_not_utf8_is_rejected(data):
    with raises(InvalidMessageError, "invalid_text"):
        decode_text(data, "the owner")
