"""Atomic writing of files that are never overwritten."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path


def write_new(path: Path, content: bytes) -> bool:
    """Write `content` to `path` unless that file exists; return whether it was written.

    A hard link puts the finished file in its place, which fails when the name is taken: two writers cannot both win,
    and a crash leaves at most a temporary file.
    """
    # In the same folder, as a hard link cannot lead to another file system
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            # Before the link: after a crash the name must not lead to half of the content
            os.fsync(file.fileno())
        os.chmod(name, 0o644)  # mkstemp's 0o600 would keep other users from reading a result
        try:
            os.link(name, path)
        except FileExistsError:
            return False
        return True
    finally:
        os.unlink(name)
