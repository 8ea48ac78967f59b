"""Page of memory between the driver and its keeper: the last command, and the number of commands sent."""

from __future__ import annotations

import mmap
import os
import struct

from hal.z1_protocol.controller import COMMAND_SIZE

_SIZE = 4096
_HEAD = struct.Struct("<QQQ")  # sequence, number of commands, whether one was recorded
_COMMAND_AT = 64
_TRIES = 100


def make_page_file() -> int:
    """Return the descriptor of a new page; its owner closes it."""
    fd = os.memfd_create("z1-keeper")
    os.ftruncate(fd, _SIZE)
    return fd


class Page:
    """The page behind the descriptor `fd`: one process writes, the other reads."""

    def __init__(self, fd: int) -> None:
        self._map = mmap.mmap(fd, _SIZE)
        self._count = 0
        self._recorded = 0

    def record(self, command: bytes | bytearray) -> None:
        """Record that a command was sent; an empty one leaves the last one in place."""
        self._count += 1
        _HEAD.pack_into(self._map, 0, 2 * self._count - 1, self._count, self._recorded)  # odd: being written
        if command:
            self._recorded = 1
            self._map[_COMMAND_AT : _COMMAND_AT + COMMAND_SIZE] = bytes(command)
        _HEAD.pack_into(self._map, 0, 2 * self._count, self._count, self._recorded)

    def count(self) -> int:
        """Return the number of commands recorded."""
        return _HEAD.unpack_from(self._map, 0)[1]

    def command(self) -> bytes | None:
        """Return the last command; None when there is none, or when it cannot be read whole."""
        for _ in range(_TRIES):
            before, _, recorded = _HEAD.unpack_from(self._map, 0)
            command = self._map[_COMMAND_AT : _COMMAND_AT + COMMAND_SIZE]
            if not recorded:
                return None
            if before % 2 == 0 and _HEAD.unpack_from(self._map, 0)[0] == before:
                return command
        return None  # its writer ended in the middle
