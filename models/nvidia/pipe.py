"""Messages between this process and a generator's own: arrays by name, as NumPy's .npz with its length in front.

Only Python and NumPy are required, of any versions: the other process has packages of its own.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping
from typing import BinaryIO

import numpy as np

from hal.base.errors import Z1Error

PROTOCOL = 2
"""Version of the messages; both sides must have the same."""
_LENGTH = struct.Struct("<Q")
_MAX_BYTES = 256 << 20  # far above any grasp set; printed text, read as a length, is far above it


class PipeError(Z1Error, RuntimeError):
    """Invalid message: cut off, too long, or without arrays."""

    default_code = "pipe"


def write_message(stream: BinaryIO, arrays: Mapping[str, np.ndarray | str | int]) -> None:
    """Write one message to `stream`."""
    body = io.BytesIO()
    np.savez(body, allow_pickle=False, **{name: np.asarray(value) for name, value in arrays.items()})
    stream.write(_LENGTH.pack(body.tell()) + body.getvalue())
    stream.flush()


def read_message(stream: BinaryIO) -> dict[str, np.ndarray] | None:
    """Return the next message of `stream`, or None where it has ended.

    Raises:
        PipeError: the stream ends within a message, or a message is invalid.
    """
    head = stream.read(_LENGTH.size)
    if not head:
        return None
    if len(head) < _LENGTH.size:
        raise PipeError("the stream ended within a message.", code="message_cut")
    (length,) = _LENGTH.unpack(head)
    if length > _MAX_BYTES:
        raise PipeError(
            f"a message of {length} bytes is announced; allowed are {_MAX_BYTES}. Check the process for prints.",
            code="message_length",
        )
    body = stream.read(length)
    if len(body) < length:
        raise PipeError("the stream ended within a message.", code="message_cut")
    try:
        with np.load(io.BytesIO(body), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception as err:  # NumPy and zipfile raise a dozen kinds for bytes that are no .npz
        raise PipeError(f"a message holds no plain arrays ({err}).", code="message_not_arrays") from err
