"""Files of a HAL process that only its user can open: the secret of its link, and the socket of its stop.

They make a client on the same machine sure of the HAL it talks to, and the HAL of the client. This module imports
nothing of size: `./z1 stop` must not wait for it.
"""

from __future__ import annotations

import os

from hal.base.runtime_folder import find_file, make_runtime_folder

SECRET_BYTES = 32


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
