"""Files of a HAL process that only its user can open: the secret of its link, and the socket of its stop.

They make a client on the same machine sure of the HAL it talks to, and the HAL of the client. This module imports
nothing of size: `./z1 stop` must not wait for it.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

from hal.base.errors import HalError

SECRET_BYTES = 32


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
                f"bus: the folder {folder} is a link, or belongs to or is open to other users (allowed: this user's, "
                f"mode 700). Remove it.",
                code="unsafe_runtime_folder",
            )
        return folder
    raise HalError(
        f"bus: none of {', '.join(map(str, runtime_folders()))} can be made. Set XDG_RUNTIME_DIR to a folder of this "
        f"user.",
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


def make_secret(port: int) -> bytes:
    """Return the secret of the link at `port`, drawn when there is none yet.

    It outlives the process, so that a client stays connected through a restart of the HAL.
    """
    if (found := read_secret(port)) is not None:
        return found
    path = make_runtime_folder() / _secret_name(port)
    path.unlink(missing_ok=True)  # unreadable or too short: of a process that was killed while it wrote
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(secret := os.urandom(SECRET_BYTES))
    return secret


def read_secret(port: int) -> bytes | None:
    """Return the secret of the link at `port`; None when this user has no HAL there."""
    path = find_file(_secret_name(port))
    if path is None:
        return None
    try:
        secret = path.read_bytes()
    except OSError:
        return None
    return secret if len(secret) == SECRET_BYTES else None


def _secret_name(port: int) -> str:
    return f"{port}.secret"


def stop_socket_name(robot: str, port: int) -> str:
    """Return the name of the socket on which the HAL of `robot` at `port` takes a stop."""
    return f"{robot}-{port}.stop"


def _is_file(mode: int) -> bool:
    return stat.S_ISREG(mode) or stat.S_ISSOCK(mode)


def _is_private(status: os.stat_result, is_kind: Callable[[int], bool]) -> bool:
    """Return True for a file of the right kind (links are not followed) that belongs to this user alone."""
    return is_kind(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077
