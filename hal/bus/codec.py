"""Codec of the messages: a msgpack header of the plain fields, then the raw bytes of the arrays.

Layout: magic `Z1`, version (1 byte), one zero byte, header length (uint32), header, arrays in field order, all
little-endian. The header is `[type name, {field: value}]`, with an array's shape in place of its values. Field types
are read from the dataclass, never from the message, so a sender cannot choose which class is constructed.
"""

from __future__ import annotations

import inspect
import math
import struct
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any, get_args, get_type_hints

import msgpack
import numpy as np

import hal.base.messages
from hal.base.errors import InvalidMessageError
from hal.bus.authentication import LeaseGrant

VERSION = 1
MAX_BYTES = 64 * 2**20
"""Maximum message; a 1280×720 RGB-D frame with mask has 7.4 MB."""
_MAX_HEADER = 64 * 2**10
_MAX_TEXT = 2000
_MAX_SHOWN = 80  # of an invalid value in an error text
_PREFIX = struct.Struct("<2sBBI")
_MAGIC = b"Z1"
_DTYPES = {"colour": np.dtype("|u1"), "depth_m": np.dtype("<f4"), "ground_truth_mask": np.dtype("|b1")}
_FLOAT = np.dtype("<f8")


@dataclass(frozen=True, slots=True, kw_only=True)
class Hello:
    """Answer of a HAL process to the handshake."""

    robot: str
    """Name of the robot."""
    versions: tuple[str, ...]
    """`name=version` of the packages that matter to the link."""
    now_s: float
    """The HAL's clock at the answer [s]."""


MESSAGES: dict[str, type] = {
    name: kind for name, kind in inspect.getmembers(hal.base.messages, inspect.isclass) if is_dataclass(kind)
} | {"Hello": Hello, "LeaseGrant": LeaseGrant}


@cache
def _schema(kind: type) -> tuple[tuple[str, Any], ...]:
    hints = get_type_hints(kind)
    return tuple((field.name, hints[field.name]) for field in fields(kind))


def _is_array(hint: Any) -> bool:
    return hint is np.ndarray or np.ndarray in get_args(hint)


def _to_plain(value: Any, hint: Any, name: str) -> Any:
    """Return a field as a type of msgpack."""
    if is_dataclass(hint) and isinstance(hint, type):
        return {key: _to_plain(getattr(value, key), sub, f"{name}.{key}") for key, sub in _schema(hint)}
    if isinstance(hint, type) and issubclass(hint, Enum):
        return value.value
    if hint in (bool, int, float, str):
        return hint(value)
    if get_args(hint) == (str, ...):
        return list(value)
    raise TypeError(f"codec: {name} has type {hint}, for which there is no rule. Add one to hal/bus/codec.py.")


def _split_message(message: Any) -> tuple[bytes, list[np.ndarray]]:
    kind = type(message)
    if MESSAGES.get(kind.__name__) is not kind:
        raise TypeError(f"codec: {kind.__name__} is not a message (known: {', '.join(sorted(MESSAGES))}).")
    plain: dict[str, Any] = {}
    arrays: list[np.ndarray] = []
    for name, hint in _schema(kind):
        value = getattr(message, name)
        if not _is_array(hint):
            plain[name] = _to_plain(value, hint, f"{kind.__name__}.{name}")
        elif value is None:
            plain[name] = None
        else:
            want = _DTYPES.get(name, _FLOAT)
            if value.dtype != want:
                raise InvalidMessageError(
                    f"codec: {kind.__name__}.{name} has dtype {value.dtype} (allowed {want}).", code="invalid_dtype"
                )
            plain[name] = list(value.shape)
            arrays.append(np.ascontiguousarray(value))  # `memoryview.cast` takes contiguous memory only
    header: bytes = msgpack.packb([kind.__name__, plain])  # pyright: ignore[reportAssignmentType] (its stub is wrong)
    return _PREFIX.pack(_MAGIC, VERSION, 0, len(header)) + header, arrays


def encode(message: Any) -> bytes:
    """Return `message` as bytes.

    Raises:
        TypeError: not a message, or a field type the codec does not know.
        InvalidMessageError: an array of another dtype than the message's (object arrays among them).
    """
    head, arrays = _split_message(message)
    # A memoryview with a zero in its shape cannot be cast.
    return b"".join([head, *(array.data.cast("B") if array.size else b"" for array in arrays)])


def encode_into(message: Any, buffer: bytearray) -> None:
    """Write `message` to `buffer`, whose length is adapted; each array is copied once."""
    head, arrays = _split_message(message)
    total = len(head) + sum(array.nbytes for array in arrays)
    if len(buffer) != total:  # once for each camera: its frames have one size
        buffer[:] = bytes(total)
    buffer[: len(head)] = head
    with memoryview(buffer) as view:
        at = len(head)
        for array in arrays:
            view[at : at + array.nbytes] = array.data.cast("B")
            at += array.nbytes


def decode(data: bytes, kind: type | None = None) -> Any:
    """Return the message in `data`, with every field checked.

    Args:
        data: one whole message.
        kind: the expected type; None = any known.

    Raises:
        InvalidMessageError: not exactly one well-formed message of this version; the code names the part:
            `invalid_length`, `invalid_magic`, `other_version`, `invalid_header`, `unknown_type`, `invalid_fields`,
            `invalid_field`, `invalid_array`.
    """
    name, plain, body = _open_envelope(data)
    if name not in MESSAGES or (kind is not None and name != kind.__name__):
        allowed = kind.__name__ if kind else ", ".join(sorted(MESSAGES))
        raise InvalidMessageError(
            f"codec: the payload is a message of type {name[:60]!r} (allowed here: {allowed}).", code="unknown_type"
        )
    found = MESSAGES[name]
    schema = _schema(found)
    if set(plain) != {field for field, _ in schema}:
        raise InvalidMessageError(
            f"codec: {name} has the fields {sorted(map(str, plain))[:20]} (needed {[f for f, _ in schema]}).",
            code="invalid_fields",
        )
    values: dict[str, Any] = {}
    at = 0
    for field, hint in schema:
        label = f"{name}.{field}"
        if not _is_array(hint):
            values[field] = _check_field(plain[field], hint, label)
        elif plain[field] is None and hint is not np.ndarray:
            values[field] = None
        else:
            values[field], at = _read_array(body, at, plain[field], _DTYPES.get(field, _FLOAT), label)
    if at != len(body):
        raise InvalidMessageError(
            f"codec: {name} has {len(body)} bytes of arrays (its header declares {at}).", code="invalid_length"
        )
    return found(**values)


def _open_envelope(data: bytes) -> tuple[str, dict[Any, Any], memoryview]:
    if not _PREFIX.size <= len(data) <= MAX_BYTES:
        raise InvalidMessageError(
            f"codec: the payload has {len(data)} bytes (allowed {_PREFIX.size} to {MAX_BYTES}).", code="invalid_length"
        )
    magic, version, zero, length = _PREFIX.unpack_from(data)
    if magic != _MAGIC or zero:
        raise InvalidMessageError(
            f"codec: the payload begins with {bytes(data[:8])!r} (needed {_MAGIC!r}).", code="invalid_magic"
        )
    if version != VERSION:
        raise InvalidMessageError(
            f"codec: the payload has format version {version} (allowed {VERSION}). Use the same version on both ends.",
            code="other_version",
        )
    end = _PREFIX.size + length
    if length > _MAX_HEADER or end > len(data):
        raise InvalidMessageError(
            f"codec: the payload declares a header of {length} bytes but has {len(data)} in all.", code="invalid_header"
        )
    try:
        header = msgpack.unpackb(data[_PREFIX.size : end])
    except (ValueError, OverflowError, msgpack.UnpackException) as err:
        raise InvalidMessageError(
            f"codec: the payload's header is not msgpack ({err}).", code="invalid_header"
        ) from err
    match header:
        case [str(name), dict(plain)]:
            return name, plain, memoryview(data)[end:]
    raise InvalidMessageError(
        f"codec: the payload's header is {str(header)[:_MAX_SHOWN]} (needed [type name, fields]).",
        code="invalid_header",
    )


def _check_field(value: Any, hint: Any, label: str) -> Any:
    """Return a plain field as its type; nothing is converted but lists to tuples and values to enum members."""
    if is_dataclass(hint) and isinstance(hint, type):
        schema = _schema(hint)
        if not isinstance(value, dict) or set(value) != {key for key, _ in schema}:
            raise _invalid_field(label, value, f"the fields {[k for k, _ in schema]}")
        return hint(**{key: _check_field(value[key], sub, f"{label}.{key}") for key, sub in schema})
    if isinstance(hint, type) and issubclass(hint, Enum):
        known = {member.value: member for member in hint}
        if not isinstance(value, str) or value not in known:
            raise _invalid_field(label, value, ", ".join(known))
        return known[value]
    if get_args(hint) == (str, ...):
        if not isinstance(value, list):
            raise _invalid_field(label, value, "a list of texts")
        return tuple(_check_field(item, str, f"{label}[{i}]") for i, item in enumerate(value))
    if type(value) is not hint:  # not `isinstance`, by which True is an int
        raise _invalid_field(label, value, f"type {hint}")
    if hint is float and not math.isfinite(value):
        raise _invalid_field(label, value, "finite values")
    return value


def _invalid_field(label: str, value: Any, allowed: str) -> InvalidMessageError:
    text = f"codec: {label} is {str(value)[:_MAX_SHOWN]!r} (allowed {allowed})."
    return InvalidMessageError(text, code="invalid_field")


def _read_array(body: memoryview, at: int, shape: Any, dtype: np.dtype, label: str) -> tuple[np.ndarray, int]:
    good = isinstance(shape, list) and len(shape) <= 4 and all(type(n) is int and 0 <= n <= MAX_BYTES for n in shape)
    # Lengths of 0 count as 1, since NumPy multiplies the lengths that are not zero.
    if not good or math.prod(max(n, 1) for n in shape) > MAX_BYTES:
        raise InvalidMessageError(
            f"codec: {label} has shape {str(shape)[:_MAX_SHOWN]} (allowed a short list of lengths).",
            code="invalid_array",
        )
    end = at + math.prod(shape) * dtype.itemsize
    if end > len(body):
        raise InvalidMessageError(
            f"codec: {label} with shape {shape} needs {end - at} bytes ({len(body) - at} left).", code="invalid_array"
        )
    raw = body[at:end]
    if dtype == np.bool_ and len(raw) and np.frombuffer(raw, np.uint8).max() > 1:
        raise InvalidMessageError(f"codec: {label} has bytes other than 0 and 1 (needed a mask).", code="invalid_array")
    return np.frombuffer(raw, dtype).reshape(shape), end


def decode_text(data: bytes, label: str) -> str:
    """Return a short UTF-8 text, such as an owner's name or a reason.

    Raises:
        InvalidMessageError: too long, or not UTF-8.
    """
    if len(data) > _MAX_TEXT:
        raise InvalidMessageError(f"codec: {label} has {len(data)} bytes (allowed {_MAX_TEXT}).", code="invalid_text")
    try:
        return data.decode()
    except UnicodeDecodeError as err:
        raise InvalidMessageError(f"codec: {label} is {data[:40]!r} (needed UTF-8 text).", code="invalid_text") from err
