"""Errors over the link: class name and text go across, and the same class is raised on the other side."""

from __future__ import annotations

import inspect

import msgpack

import hal.errors
from hal.errors import HalError

_KINDS: dict[str, type[HalError]] = {
    name: kind for name, kind in inspect.getmembers(hal.errors, inspect.isclass) if issubclass(kind, HalError)
}
_MAX_TEXT = 4000


def encode_error(error: HalError) -> bytes:
    """Return `error` as bytes; a class that is not in `hal.errors` goes as its nearest parent there."""
    kind = next(parent.__name__ for parent in type(error).__mro__ if _KINDS.get(parent.__name__) is parent)
    return msgpack.packb([kind, str(error)[:_MAX_TEXT]])  # pyright: ignore[reportReturnType] (its stub is wrong)


def decode_error(data: bytes) -> HalError:
    """Return the error in `data`, ready to be raised; what cannot be read becomes a plain `HalError`."""
    try:
        content = msgpack.unpackb(data)
    except (ValueError, msgpack.UnpackException):
        content = None
    match content:
        case [str(kind), str(text)] if kind in _KINDS:
            # The constructors build the text from parts; here it is complete already.
            error = _KINDS[kind].__new__(_KINDS[kind], text)
            error.args = (text,)
            return error
    return HalError(f"the HAL process answered with an error that cannot be read: {data[:80]!r}.")
