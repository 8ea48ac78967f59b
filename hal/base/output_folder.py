"""Folders of results: locked for one run at a time, and never a link to somewhere else."""

from __future__ import annotations

import fcntl
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from hal.base.errors import UsageError

_LOG = logging.getLogger(__name__)


class OutputError(UsageError):
    """A folder or file that cannot take results."""

    default_code = "output_unusable"


@contextmanager
def open_output(folder: Path) -> Iterator[Path]:
    """Create `folder`, and keep other runs out of it until the block ends, also by a crash.

    Raises:
        OutputError: another run uses it (`output_locked`), it is a link (`output_link`), or nothing can be written
            there (`output_unusable`).
    """
    descriptor = _open_folder(folder)
    try:
        try:
            # On the folder itself: there is no lock file to clean up, and the system releases it with the process
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputError(
                f"output: another run writes into {folder}. Wait for its end, or give another --out.",
                code="output_locked",
            ) from error
        except OSError as error:  # network file systems without locks
            _LOG.warning("output: %s cannot be locked (%s); start no second run with it.", folder, error.strerror)
        yield folder
    finally:
        os.close(descriptor)


def _open_folder(folder: Path) -> int:
    try:
        if folder.is_symlink():
            raise OutputError(
                f"output: {folder} is a symbolic link to {os.readlink(folder)}, which is not followed. Give that "
                f"folder itself.",
                code="output_link",
            )
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OutputError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = (error.strerror if isinstance(error, OSError) else None) or error
        raise OutputError(f"output: {folder} cannot be a folder of results ({reason}). Give another --out.") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        os.close(descriptor)
        raise OutputError(f"output: {folder} cannot be written (no permission). Give another --out.")
    return descriptor


def check_output_file(path: Path) -> Path:
    """Return `path` after its folder was created, so that `hal.base.files.atomic_write` can write it.

    Raises:
        OutputError: it is a folder, or its folder cannot be written.
    """
    try:
        if path.is_dir():
            raise OutputError(f"output: {path} is a folder. Give the name of a file in it.")
        path.parent.mkdir(parents=True, exist_ok=True)
        writable = os.access(path.parent, os.W_OK | os.X_OK)
    except OutputError:
        raise
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or error
        raise OutputError(f"output: {path} cannot be written ({reason}). Give another --out.") from error
    if not writable:
        raise OutputError(f"output: {path.parent} cannot be written (no permission). Give another --out.")
    return path


def create_file(path: Path) -> BinaryIO:
    """Open a new, empty file at `path` for writing; a file or link there is removed, not written through."""
    path.unlink(missing_ok=True)
    return path.open("xb")
