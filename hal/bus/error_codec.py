"""Error codec of the link: class, code and text travel, and the same class is raised on the other side."""

from __future__ import annotations

import inspect

import msgpack

import hal.base.errors
from hal.base.errors import HalError

_KINDS: dict[str, type[HalError]] = {
    name: kind for name, kind in inspect.getmembers(hal.base.errors, inspect.isclass) if issubclass(kind, HalError)
}
_MAX_TEXT = 4000  # about forty times the longest text of ours: a bound, not a limit in use


def encode_error(error: HalError) -> bytes:
    """Return `error` as bytes; a class that is not in `hal.base.errors` is sent as its nearest parent there."""
    kind = next(parent.__name__ for parent in type(error).__mro__ if _KINDS.get(parent.__name__) is parent)
    content = [kind, str(error)[:_MAX_TEXT], error.code[:_MAX_TEXT]]
    return msgpack.packb(content)  # pyright: ignore[reportReturnType] (its stub is wrong)


def decode_error(data: bytes) -> HalError:
    """Return the error in `data`, ready to be raised; unreadable data becomes a plain `HalError`."""
    try:
        content = msgpack.unpackb(data)
    except (ValueError, msgpack.UnpackException):
        content = None
    match content:
        case [str(kind), str(text), str(code)] if kind in _KINDS:
            # The constructors build the text from parts; here it is complete already.
            error = _KINDS[kind].__new__(_KINDS[kind], text)
            error.args, error.code = (text,), code
            return error
    return HalError(
        f"bus: the HAL process answered with an unreadable error ({data[:80]!r}). Use the same version on both ends.",
        code="unreadable_error",
    )
