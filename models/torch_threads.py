"""How torch uses this processor: threads within which it starts none of its own, and bfloat16."""

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


def has_bfloat16() -> bool:
    """Return whether the processor computes in bfloat16; where it only imitates that, float32 is faster."""
    import torch

    return bool(torch.cpu.get_capabilities().get("avx512_bf16", False))
