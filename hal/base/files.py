"""Atomic writing of files: readers find the old content or the complete new one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PARTIAL = ".partial"
"""Ending of an unfinished file, after the name of the final one; only a killed process leaves one."""


def atomic_write(path: Path, data: bytes | str) -> None:
    """Write `data`, text as UTF-8, to `path`, which is replaced once it is complete."""
    with atomic_path(path) as partial:
        partial.write_bytes(data.encode() if isinstance(data, str) else data)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a path in the folder of `path` for the content; it replaces `path` at the end, or is removed on an error.

    Its name does not end like that of `path`: a library that appends a missing ending needs an open file.
    """
    # The process id keeps two processes that make the same file apart
    partial = path.with_name(f".{path.name}.{os.getpid()}{PARTIAL}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
