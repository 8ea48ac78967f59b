"""Use of the processor by torch: worker threads without torch's own thread pool, and bfloat16."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor


def single_threaded_workers(count: int, name: str) -> ThreadPoolExecutor:
    """Return a pool of `count` workers called `name`, in each of which torch uses one thread.

    Torch's own threads synchronise after every operation, some thousand times a call: next to a servo loop on two
    cores that took 12 s instead of 0.2 s. These workers synchronise once, at the end.
    """
    import torch

    before = torch.get_num_threads()

    def begin() -> None:
        torch.set_num_threads(1)
        torch.get_num_threads()  # settles this thread's number, so that the restoring below does not reach it

    barrier = threading.Barrier(count)
    workers = ThreadPoolExecutor(count, thread_name_prefix=name, initializer=begin)
    list(workers.map(lambda _: barrier.wait(), range(count)))  # every thread has run `begin`
    torch.set_num_threads(before)
    return workers


def has_bfloat16() -> bool:
    """Return whether the processor has bfloat16 instructions; emulated bfloat16 is slower than float32."""
    import torch

    return bool(torch.cpu.get_capabilities().get("avx512_bf16", False))
