"""Memory shared by processes, freed with the last of them: poses of a world, injected faults of its arm, images."""

from __future__ import annotations

import mmap
import os
import tempfile

import numpy as np

from hal.base.errors import HalError
from sim_twin.controller.fault_injection import INJECTED_FAULTS

_MAX_POSITIONS = 512
_WORLD = np.dtype(
    [
        ("version", "<u8"),
        ("time_s", "<f8"),
        ("nq", "<u8"),
        ("qpos", "<f8", (_MAX_POSITIONS,)),
        ("start_height_m", "<f8"),
        ("injected_faults", INJECTED_FAULTS),
    ]
)
_MAX_TRIES = 1000  # a write takes microseconds: so many torn reads in a row mean that the writer ended


def make_memory(size: int) -> int:
    """Return the descriptor of an anonymous file of `size` bytes; pass it to a child process by `pass_fds`."""
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create("z1-twin")
    else:
        # memfd_create is Linux's alone
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
    os.ftruncate(fd, size)
    return fd


def map_memory(fd: int, dtype: np.dtype, shape: tuple[int, ...] = ()) -> np.ndarray:
    """Return a writable array at the beginning of the memory behind `fd`."""
    size = dtype.itemsize * int(np.prod(shape))
    return np.ndarray(shape, dtype, buffer=mmap.mmap(fd, size))


class SharedWorld:
    """Poses of one world, written by one process and read by any, and injected faults in the opposite direction.

    Args:
        fd: descriptor of a memory of `SharedWorld.SIZE` bytes.
    """

    SIZE = _WORLD.itemsize

    def __init__(self, fd: int) -> None:
        self._record = map_memory(fd, _WORLD)
        self._version = self._record["version"]
        self._time_s = self._record["time_s"]
        self._nq, self._qpos = self._record["nq"], self._record["qpos"]
        self._start_height_m = self._record["start_height_m"]
        self.injected_faults: np.ndarray = self._record["injected_faults"]
        """A record of `sim_twin.controller.fault_injection.INJECTED_FAULTS`."""

    @property
    def start_height_m(self) -> float:
        """Initial height of the object's lowest point [m]; the publisher sets it."""
        return float(self._start_height_m)

    @start_height_m.setter
    def start_height_m(self, height_m: float) -> None:
        self._start_height_m[...] = height_m

    def publish(self, time_s: float, qpos: np.ndarray) -> None:
        """Write MuJoCo's time [s] and positions (nq,), at most 512."""
        self._version |= 1  # odd during a write; already odd if an earlier publisher ended during one
        self._time_s[...] = time_s
        self._nq[...] = len(qpos)
        self._qpos[: len(qpos)] = qpos
        self._version += 1

    def read(self) -> tuple[float, np.ndarray]:
        """Return the newest time [s] and positions (nq,), of one instant.

        Raises:
            HalError: the publisher ended during a write.
        """
        # A seqlock: the read is repeated when a write was in progress, or happened meanwhile
        for _ in range(_MAX_TRIES):
            before = int(self._version)
            time_s, qpos = float(self._time_s), self._qpos[: int(self._nq)].copy()
            if before % 2 == 0 and before == int(self._version):
                return time_s, qpos
        raise HalError("twin: the process of the world ended during a write; start it again.", code="torn_write")
