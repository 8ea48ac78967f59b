"""Memory that processes share, gone when the last of them is: the poses of a world, what ails its arm, and pictures."""

from __future__ import annotations

import mmap
import os
import tempfile

import numpy as np

from sim_twin.controller.fault_injection import AILMENTS

_MOST_POSITIONS = 512
_WORLD = np.dtype(
    [
        ("version", "<u8"),
        ("time_s", "<f8"),
        ("nq", "<u8"),
        ("qpos", "<f8", (_MOST_POSITIONS,)),
        ("start_height_m", "<f8"),
        ("ailments", AILMENTS),
    ]
)
_MOST_TRIES = 1000


def make_memory(size: int) -> int:
    """Return the descriptor of a file of `size` bytes without a name; hand it to a child process by `pass_fds`."""
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create("z1-twin")
    else:
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
    os.ftruncate(fd, size)
    return fd


def map_memory(fd: int, dtype: np.dtype, shape: tuple[int, ...] = ()) -> np.ndarray:
    """Return an array in the memory behind `fd`, from its beginning, to read and write."""
    size = dtype.itemsize * int(np.prod(shape))
    return np.ndarray(shape, dtype, buffer=mmap.mmap(fd, size))


class SharedWorld:
    """The poses of one world: one process publishes, any may read. What ails the arm goes the other way.

    Args:
        fd: of memory of `SharedWorld.SIZE` bytes.
    """

    SIZE = _WORLD.itemsize

    def __init__(self, fd: int) -> None:
        self._record = map_memory(fd, _WORLD)
        self._version = self._record["version"]
        self._time_s = self._record["time_s"]
        self._nq, self._qpos = self._record["nq"], self._record["qpos"]
        self._start_height_m = self._record["start_height_m"]
        self.ailments: np.ndarray = self._record["ailments"]
        """A record of `sim_twin.controller.fault_injection.AILMENTS`."""

    @property
    def start_height_m(self) -> float:
        """Where the object's lowest point was at the start [m]; the publisher sets it."""
        return float(self._start_height_m)

    @start_height_m.setter
    def start_height_m(self, height_m: float) -> None:
        self._start_height_m[...] = height_m

    def publish(self, time_s: float, qpos: np.ndarray) -> None:
        """Write MuJoCo's time [s] and positions (nq,), at most 512."""
        self._version |= 1  # odd while it is written; and it is already if the publisher before died writing
        self._time_s[...] = time_s
        self._nq[...] = len(qpos)
        self._qpos[: len(qpos)] = qpos
        self._version += 1

    def read(self) -> tuple[float, np.ndarray]:
        """Return the newest time [s] and positions (nq,), of one instant.

        Raises:
            RuntimeError: the publisher died while it wrote.
        """
        for _ in range(_MOST_TRIES):
            before = int(self._version)
            time_s, qpos = float(self._time_s), self._qpos[: int(self._nq)].copy()
            if before % 2 == 0 and before == int(self._version):
                return time_s, qpos
        raise RuntimeError("the process that moves the twin ended while it wrote; start it again.")
