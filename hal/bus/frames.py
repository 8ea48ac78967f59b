"""Sending frames: through shared memory where there is any, else as bytes over the link."""

from __future__ import annotations

import atexit
import logging
import os
import struct
from dataclasses import dataclass
from pathlib import Path

import zenoh
from zenoh import shm

from hal.base.errors import InvalidMessageError
from hal.base.messages import Intrinsics, RgbdFrame
from hal.bus.codec import encode_into

_LOG = logging.getLogger(__name__)
_SHM_DIR = Path("/dev/shm")
_FRAMES_IN_POOL = 6
"""One being written, one in flight, and the newest held by each of a few listeners."""
_BYTES_PER_PIXEL = 3 + 4 + 1  # colour, depth, mask
_STAMP = struct.Struct("<ddQ")
_MAX_TIME_S = 1e12


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameStamp:
    """Attachment of a frame, by which a client drops a stale frame without decoding it."""

    sent_s: float
    """The HAL's clock at the moment of sending [s]."""
    exposed_s: float
    """`RgbdFrame.stamp_s` [s]."""
    sequence: int
    """`RgbdFrame.sequence`."""

    def pack(self) -> bytes:
        """Return it as an attachment."""
        return _STAMP.pack(self.sent_s, self.exposed_s, self.sequence)

    @staticmethod
    def unpack(data: bytes) -> FrameStamp:
        """Return the stamp in an attachment.

        Raises:
            InvalidMessageError: wrong length, or a time that is not finite.
        """
        if len(data) != _STAMP.size:
            raise InvalidMessageError(
                f"bus: a frame's stamp has {len(data)} bytes (allowed {_STAMP.size}).", code="invalid_stamp"
            )
        sent_s, exposed_s, sequence = _STAMP.unpack(data)
        # Also catches NaN; no clock of a machine reaches 30,000 years.
        if not (abs(sent_s) < _MAX_TIME_S and abs(exposed_s) < _MAX_TIME_S):
            raise InvalidMessageError(
                f"bus: a frame's stamp has the times {sent_s} and {exposed_s} (allowed below {_MAX_TIME_S:g} s).",
                code="invalid_stamp",
            )
        return FrameStamp(sent_s=sent_s, exposed_s=exposed_s, sequence=sequence)


class FrameBuffers:
    """Buffers for frames of one size, in shared memory if possible."""

    def __init__(self, intrinsics: Intrinsics, *, shared: bool) -> None:
        self._buffer = bytearray()
        before = existing_segments()
        # The 4096 B are for the header of the encoded frame.
        size = _FRAMES_IN_POOL * (_BYTES_PER_PIXEL * intrinsics.width * intrinsics.height + 4096)
        self._provider = _make_provider(size) if shared else None
        # Not before the process ends: Zenoh's own records belong to it, and a later provider needs them too.
        atexit.register(unlink_segments, mapped_segments() - before)

    @property
    def shared(self) -> bool:
        """True when frames go through shared memory."""
        return self._provider is not None

    def fill(self, frame: RgbdFrame) -> shm.ZShmMut | bytes:
        """Return `frame` encoded, ready to be put."""
        encode_into(frame, self._buffer)
        if self._provider is not None:
            try:
                block = self._provider.alloc(len(self._buffer), shm.GarbageCollect())
            except zenoh.ZError as err:
                _LOG.debug("no shared memory for frame %d (%s): sent as bytes.", frame.sequence, err)
            else:
                block[0 : len(self._buffer)] = self._buffer
                return block
        return bytes(self._buffer)

    def close(self) -> None:
        """Free the shared memory; a reader that still holds a frame keeps it until it drops the frame."""
        self._provider = None


def _make_provider(size: int) -> shm.ShmProvider | None:
    # A segment larger than the space left in /dev/shm is granted, and kills the writer with SIGBUS later: check first.
    try:
        space = os.statvfs(_SHM_DIR)
        free = space.f_bavail * space.f_frsize
        if free < 2 * size:
            raise OSError(f"{_SHM_DIR} has {free / 2**20:.0f} MiB left; {2 * size / 2**20:.0f} are needed")
        provider = shm.ShmProvider.default_backend(size)
        provider.alloc(1)  # creates the segment of Zenoh's own records too
    except (OSError, zenoh.ZError) as err:
        _LOG.warning("no shared memory (%s): frames go as bytes over the link, a few milliseconds slower.", err)
        return None
    return provider


def existing_segments() -> set[Path]:
    """Return all of Zenoh's shared-memory files on this machine."""
    return set(_SHM_DIR.glob("*.zenoh"))


def mapped_segments() -> set[Path]:
    """Return Zenoh's shared-memory files that this process has mapped; empty where /proc is not Linux's."""
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return set()
    names = {line.split(maxsplit=5)[-1] for line in lines if line.endswith(".zenoh")}
    return {Path(name) for name in names if Path(name).parent == _SHM_DIR}


def unlink_segments(segments: set[Path]) -> None:
    """Remove shared-memory files that Zenoh 1.10 leaves behind when the process that created them ends first."""
    for path in segments:
        path.unlink(missing_ok=True)
