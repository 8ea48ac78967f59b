"""Folder for the sockets and secrets of a HAL, which only its user can open.

This module imports nothing of size: `./z1 stop` must not wait for it.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

from hal.base.errors import HalError


def runtime_folders() -> tuple[Path, ...]:
    """Return the folders of this user in which a HAL may keep its files, the preferred one first.

    A service, `su` and `cron` have no XDG_RUNTIME_DIR, and a desktop has: both must find the same HAL.
    """
    uid = os.getuid()
    named = os.environ.get("XDG_RUNTIME_DIR")
    parents = [Path(named)] if named else []
    parents.append(Path(f"/run/user/{uid}"))
    return (*(parent / "z1" for parent in dict.fromkeys(parents)), Path(f"/tmp/z1-{uid}"))


def make_runtime_folder() -> Path:
    """Return the first usable folder of `runtime_folders`, made if it is missing.

    Raises:
        HalError: none can be made (`no_runtime_folder`), or another user can write to it (`unsafe_runtime_folder`).
    """
    for folder in runtime_folders():
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
        except OSError:  # its parent is missing or read-only
            continue
        if not _is_private(folder.lstat(), stat.S_ISDIR):
            raise HalError(
                f"the folder {folder} is a link, or belongs to or is open to other users (allowed: this user's, "
                f"mode 700). Remove it.",
                code="unsafe_runtime_folder",
            )
        return folder
    raise HalError(
        f"none of {', '.join(map(str, runtime_folders()))} can be made. Set XDG_RUNTIME_DIR to a folder of this user.",
        code="no_runtime_folder",
    )


def find_file(name: str) -> Path | None:
    """Return the file or socket `name` of this user's HAL; None when there is none that only this user can open."""
    for folder in runtime_folders() if Path(name).name == name else ():
        try:
            safe = _is_private(folder.lstat(), stat.S_ISDIR) and _is_private((folder / name).lstat(), _is_file)
        except OSError:
            continue
        if safe:
            return folder / name
    return None


def _is_file(mode: int) -> bool:
    return stat.S_ISREG(mode) or stat.S_ISSOCK(mode)


def _is_private(status: os.stat_result, is_kind: Callable[[int], bool]) -> bool:
    """Return True for a file of the right kind (links are not followed) that belongs to this user alone."""
    return is_kind(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077
