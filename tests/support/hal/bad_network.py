"""A network with one kind of fault on a ratio of its datagrams; a `z1_peer.MemoryLink.mangle`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Fate = Callable[[np.random.Generator, bytes], list[tuple[int, bytes]]]
"""Maps a datagram to the ones that arrive, each with its delay in later datagrams of the same direction."""

_LONGEST = 300


def _flip_bits(rng: np.random.Generator, data: bytes) -> bytes:
    changed = bytearray(data)
    for at in rng.integers(len(data), size=1 + int(rng.integers(4))):
        changed[at] ^= 1 << int(rng.integers(8))
    return bytes(changed)


FATES: dict[str, Fate] = {
    "lost": lambda rng, data: [],
    "doubled": lambda rng, data: [(0, data), (0, data)],
    "out of order": lambda rng, data: [(1 + int(rng.integers(3)), data)],
    "delayed by 20 to 50 ms": lambda rng, data: [(10 + int(rng.integers(16)), data)],
    "with wrong bits": lambda rng, data: [(0, _flip_bits(rng, data))],
    "cut short": lambda rng, data: [(0, data[: rng.integers(len(data))])],
    "too long": lambda rng, data: [(0, data + rng.bytes(1 + int(rng.integers(_LONGEST))))],
    "replaced by noise": lambda rng, data: [(0, rng.bytes(int(rng.integers(_LONGEST))))],
}


class BadNetwork:
    """A link that passes each datagram at once, or with probability `ratio` through `fate`."""

    def __init__(self, fate: Fate, ratio: float = 0.1, seed: int = 0) -> None:
        self._fate = fate
        self._ratio = ratio
        self._rng = np.random.default_rng(seed)
        # Commands and answers differ in size, which keys their queues.
        self._late: dict[int, list[tuple[int, bytes]]] = {}
        self.touched = 0
        """Number of datagrams that went through `fate`."""

    def __call__(self, data: bytes) -> list[bytes]:
        late = [(left - 1, one) for left, one in self._late.get(len(data), [])]
        arriving = [(0, data)]
        if self._rng.random() < self._ratio:
            self.touched += 1
            arriving = self._fate(self._rng, data)
        self._late[len(data)] = [(left, one) for left, one in (*late, *arriving) if left > 0]
        return [one for left, one in (*late, *arriving) if left <= 0]
