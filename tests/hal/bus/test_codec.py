"""Every message survives the wire, and nothing else gets through it."""

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
def test_a_message_comes_back_as_it_went(sample):
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
    with pytest.raises(ValueError, match="read-only"):
        decode(encode(STATUS)).q_command[0] = 1.0


def test_object_arrays_are_refused():
    state = ArmState(stamp_s=0.0, q=np.zeros(7), dq=np.zeros(7), tau=np.zeros(7))
    object.__setattr__(state, "q", np.array([object()] * 7))
    with pytest.raises(InvalidMessageError, match="object"):
        encode(state)


def test_what_is_not_a_message_is_not_encoded():
    with pytest.raises(TypeError, match="not a message"):
        encode({"q": 1})


def test_a_message_of_another_type_than_asked_for_is_refused():
    with pytest.raises(InvalidMessageError, match=r"'ArmSetpoint'.*allowed here: ArmState"):
        decode(encode(ArmSetpoint(q=np.zeros(7), dq=np.zeros(7))), ArmState)


def test_another_version_is_refused_with_both_numbers():
    data = bytearray(ENCODED[0])
    data[2] = 9
    with pytest.raises(InvalidMessageError, match=r"version 9.*speaks 1"):
        decode(bytes(data))


def test_oversize_is_refused_before_it_is_looked_at():
    with pytest.raises(InvalidMessageError, match=f"allowed are 8 to {MAX_BYTES}"):
        decode(bytes(MAX_BYTES + 1))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "0 bytes"),
        (b"hello, world", "begins with"),
        (_envelope(["os.system", {"command": "true"}]), "os.system"),
        (_envelope(["ArmSetpoint", {}]), "needed are"),
        (_envelope({"type": "ArmSetpoint"}), "expected is"),
        (_envelope(["ArmSetpoint", {"q": [7], "dq": [2**62]}], bytes(56)), "shape"),
        (_envelope(["ArmSetpoint", {"q": [7], "dq": [-7]}], bytes(112)), "shape"),
        (_envelope(["ArmSetpoint", {"q": [0, 2**26, 2**26, 2**26], "dq": [7]}], bytes(56)), "shape"),
        (_envelope(["ArmSetpoint", {"q": [7], "dq": [7]}], bytes(111)), "55 are there"),
        (_envelope(["ArmSetpoint", {"q": [7], "dq": [7]}], bytes(113)), "113 bytes"),
        (_envelope(["ArmSetpoint", {"q": [6], "dq": [7]}], bytes(104)), r"\(6,\)"),
        (_envelope(["ArmSetpoint", {"q": [7], "dq": [7]}], bytes(48) + np.float64(np.nan).tobytes() * 8), "finite"),
        (_with(STATUS, mode="dancing"), "dancing"),
        (_with(STATUS, mode=["holding"]), "mode"),
        (_with(STATUS, ticks=1.0), "ticks"),
        (_with(STATUS, ticks=True), "ticks"),
        (_with(STATUS, finished=1), "finished"),
        (_with(STATUS, stamp_s=float("inf")), "finite"),
        (_with(STATUS, q_command=None), "q_command"),
        (_with(SAMPLES[1], intrinsics={"width": 6}), "intrinsics"),
        (_with(SAMPLES[1], intrinsics={**dataclasses.asdict(INTRINSICS), "width": 7}), "shape"),
        (_with(SAMPLES[3], faults="hot"), "faults"),
        (_with(SAMPLES[3], faults=[1]), r"faults\[0\]"),
        (ENCODED[2][:-1] + b"\x02", "mask"),
        (b"Z1\x01\x00\xff\xff\xff\xff" + bytes(50), "header of 4294967295 bytes"),
    ],
)
def test_each_kind_of_damage_is_named(data, words):
    with pytest.raises(InvalidMessageError, match=words):
        decode(data)


def _only_messages_or_refusals(data: bytes) -> None:
    try:
        message = decode(data)
    except InvalidMessageError:
        return
    assert type(message) in {type(sample) for sample in SAMPLES}


@given(st.sampled_from(ENCODED), st.data())
def test_a_truncated_message_is_always_refused(data, draw):
    cut = draw.draw(st.integers(0, len(data) - 1))
    with pytest.raises(InvalidMessageError):
        decode(data[:cut])


@given(st.sampled_from(ENCODED), st.data())
def test_mutated_bytes_give_a_message_or_a_refusal(data, draw):
    damaged = bytearray(data)
    for _ in range(draw.draw(st.integers(1, 4))):
        # Most of a message is array: aim at the header half of the time.
        end = draw.draw(st.sampled_from([min(len(data), 120), len(data)]))
        damaged[draw.draw(st.integers(0, end - 1))] = draw.draw(st.integers(0, 255))
    _only_messages_or_refusals(bytes(damaged))


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=8) | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


@given(st.sampled_from(SAMPLES), st.data())
def test_any_value_in_any_field_gives_a_message_or_a_refusal(sample, draw):
    field = draw.draw(st.sampled_from([field.name for field in dataclasses.fields(sample)]))
    _only_messages_or_refusals(_with(sample, **{field: draw.draw(_JSON)}))


@given(st.binary(max_size=200), st.booleans())
def test_arbitrary_bytes_are_refused(data, framed):
    if framed:
        data = b"Z1\x01\x00" + len(data).to_bytes(4, "little") + data
    with pytest.raises(InvalidMessageError):
        decode(data)


@pytest.mark.parametrize(("data", "words"), [(b"\xff\xfe", "UTF-8"), (b"a" * 2001, "2001 bytes")])
def test_a_text_that_is_too_long_or_not_utf8_is_refused(data, words):
    with pytest.raises(InvalidMessageError, match=words):
        decode_text(data, "the owner")
