"""Threads within which torch starts no threads of its own."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor


def single_threaded_workers(count: int, name: str) -> ThreadPoolExecutor:
    """Return workers called `name` within which torch uses one thread each.

    Torch's own threads wait for each other after every operation, some thousand times a call: beside a servo loop on
    two cores that took 12 s where 0.2 s were due. These wait once, at the end.
    """
    import torch

    before = torch.get_num_threads()

    def begin() -> None:
        torch.set_num_threads(1)
        torch.get_num_threads()  # settles this thread's number, so that the restoring below does not reach it

    barrier = threading.Barrier(count)
    workers = ThreadPoolExecutor(count, thread_name_prefix=name, initializer=begin)
    list(workers.map(lambda _: barrier.wait(), range(count)))  # all have begun
    torch.set_num_threads(before)
    return workers
