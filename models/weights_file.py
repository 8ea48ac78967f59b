"""What all networks share: weights as one `.npz` without pickles and a file with its SHA-256, and torch's threads."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from hal.base.errors import InvalidValueError, UsageError

WEIGHTS_FOLDER = Path(__file__).resolve().parent / "weights"


class WeightsError(UsageError):
    """Weights file that is missing, damaged or of another network."""

    default_code = "weights"


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> str:
    """Write `arrays` to `path` and their SHA-256 next to it; return the latter.

    An existing file stays whole until the new one is complete.

    Raises:
        InvalidValueError: `path` does not end in .npz.
    """
    if path.suffix != ".npz":
        raise InvalidValueError(f"{path} must end in .npz: weights are kept as NumPy arrays.", code="weights_suffix")
    from hal.base.files import atomic_path, atomic_write  # a generator's own process writes no weights

    with atomic_path(path) as partial:
        with partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        digest = sha256_of(partial)
    atomic_write(path.with_suffix(".sha256"), f"{digest}  {path.name}\n")
    return digest


def read_arrays(path: Path, make_command: str) -> dict[str, np.ndarray]:
    """Return the arrays of the file at `path`; `make_command` is named in errors as the way to make it.

    Raises:
        WeightsError: the file or its checksum is missing, they differ, or the file holds no plain arrays.
    """
    from hal.base.files import read_npz

    verify_sha256(path, make_command)
    try:
        return read_npz(path)
    except (ValueError, OSError) as err:
        raise WeightsError(
            f"{path.name} holds no plain NumPy arrays ({err}); make it again with `{make_command}`.",
            code="weights_not_arrays",
        ) from err


def verify_sha256(path: Path, make_command: str) -> str:
    """Return the SHA-256 of the file at `path` after comparing it with its checksum file.

    Raises:
        WeightsError: the file or its checksum is missing, or they differ.
    """
    checksum = path.with_suffix(".sha256")
    for needed in (path, checksum):
        if not needed.is_file():
            raise WeightsError(
                f"{needed} is missing; restore it, or make it with `{make_command}`.", code="weights_missing"
            )
    # Whatever its encoding: a damaged checksum is one that differs
    actual, expected = sha256_of(path), next(iter(checksum.read_text(errors="replace").split()), "nothing")
    if actual != expected:
        raise WeightsError(
            f"{path.name} has SHA-256 {actual[:12]}…, {checksum.name} says {expected[:12]}…: the file is damaged or "
            "was exchanged; restore both from the repository.",
            code="weights_damaged",
        )
    return actual


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of the file at `path`, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


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
