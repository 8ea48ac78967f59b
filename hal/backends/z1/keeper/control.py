"""Control of a keeper by other processes of the same user, over a Unix socket named after the driver's port."""

from __future__ import annotations

import contextlib
import json
import socket
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hal.base.errors import CommandRejectedError, HalTimeoutError
from hal.base.runtime_folder import find_file, make_runtime_folder

_TIMEOUT_S = 3.0
_MAX_BYTES = 65536


@dataclass(frozen=True, slots=True, kw_only=True)
class KeeperStatus:
    """State of a keeper."""

    pid: int
    """Process id of the keeper."""
    owner_pid: int
    """Process id of the driver, which may have ended."""
    phase: str
    """`hal.backends.z1.keeper.holding.Phase`."""
    q: tuple[float, ...] = ()
    """(7,) measured joints [rad]; empty in standby."""
    grip_nm: float = 0.0
    """Torque of the gripper [Nm]; the jaws hold something when it is more than friction."""


def new_socket_path(local: tuple[str, int]) -> Path:
    """Return the path for the socket of the keeper of the driver at address and port `local`.

    Raises:
        HalError: this user has no folder for it (`no_runtime_folder`, `unsafe_runtime_folder`).
    """
    return make_runtime_folder() / _socket_name(local)


def find(local: tuple[str, int]) -> KeeperStatus | None:
    """Return the status of the keeper at address and port `local`; None when there is none."""
    answer = _request(local, "status")
    return None if answer is None else KeeperStatus(**{**answer, "q": tuple(answer["q"])})


def hand_over(local: tuple[str, int]) -> bool:
    """Let a keeper that holds an arm close its port and end; return whether there was one.

    Raises:
        CommandRejectedError: its driver still runs (`keeper_busy`).
    """
    return _request(local, "hand over") is not None


def release(local: tuple[str, int]) -> bool:
    """Let a keeper bring its arm to PASSIVE, where it sinks; return whether there was one.

    Raises:
        CommandRejectedError: its driver still runs (`keeper_busy`).
        HalTimeoutError: the controller does not go to PASSIVE (`no_answer`).
    """
    return _request(local, "release") is not None


def reply(connection: socket.socket, answer: KeeperStatus | str) -> None:
    """Answer a request: a status, or the reason for which it cannot be fulfilled. Never raises."""
    body: dict[str, Any] = {"error": answer} if isinstance(answer, str) else asdict(answer)
    with contextlib.suppress(OSError):
        connection.sendall(json.dumps(body).encode() + b"\n")


def _request(local: tuple[str, int], request: str) -> dict[str, Any] | None:
    path = find_file(_socket_name(local))
    if path is None:
        return None
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(_TIMEOUT_S)
        try:
            connection.connect(str(path))
            connection.sendall(request.encode() + b"\n")
            data = b""
            while not data.endswith(b"\n") and len(data) < _MAX_BYTES and (more := connection.recv(4096)):
                data += more
        except (FileNotFoundError, ConnectionError):  # none, or one that was killed
            return None
        except OSError as error:
            raise HalTimeoutError(
                f"Z1 keeper: no answer to {request!r} within {_TIMEOUT_S:.0f} s ({error}). Support the arm, then end "
                f"the keeper's process.",
                code="no_answer",
            ) from error
    if not data:
        return None
    answer = json.loads(data)
    if "error" in answer:
        raise CommandRejectedError(f"Z1 keeper: {answer['error']}", code="keeper_busy")
    return answer


def _socket_name(local: tuple[str, int]) -> str:
    return f"keeper-{local[0]}-{local[1]}.sock"
