"""The stop without a session: a Unix datagram socket of the HAL, which no network connection can block.

A datagram `stop REASON` latches the stop, `status` only asks; the answer is one line, `MODE<tab>REASON<tab>OWNER`
or `error TEXT`. The socket's file is open to the HAL's user alone. The client's part imports nothing of size.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable
from contextlib import suppress
from threading import Thread
from typing import NamedTuple

from hal.base.errors import HalError, HalTimeoutError
from hal.base.runtime_folder import find_file, make_runtime_folder
from hal.bus.runtime_files import stop_socket_name

_LOG = logging.getLogger(__name__)
_MAX_BYTES = 4096
_STOP, _STATUS, _ERROR = b"stop ", b"status", b"error "


class StopAnswer(NamedTuple):
    """The servo as it answers a stop."""

    mode: str
    """Value of its `hal.base.messages.ServoMode`."""
    reason: str
    owner: str


class StopSocket:
    """The HAL's end; it serves from a thread of its own until `close()`.

    Args:
        robot: name of the robot.
        port: the link's, which distinguishes two HALs of one user.
        stop: latches the stop with a reason.
        read_status: reads the servo.

    Raises:
        HalError: there is no folder for it.
    """

    def __init__(
        self, robot: str, port: int, stop: Callable[[str], None], read_status: Callable[[], StopAnswer]
    ) -> None:
        self._stop, self._read_status = stop, read_status
        self.path = make_runtime_folder() / stop_socket_name(robot, port)
        self.path.unlink(missing_ok=True)  # of a killed HAL; a running one has the port, which is opened first
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(self.path))
        self.path.chmod(0o600)
        self._closing = False
        self._thread = Thread(target=self._serve, name="bus stop socket", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and remove the socket. No effect when closed before."""
        if self._closing:
            return
        self._closing = True
        self._socket.shutdown(socket.SHUT_RD)  # wakes the thread
        self._thread.join()
        self._socket.close()
        self.path.unlink(missing_ok=True)

    def _serve(self) -> None:
        while True:
            try:
                request, client = self._socket.recvfrom(_MAX_BYTES)
            except OSError:
                _LOG.exception("the stop's socket failed; `./z1 stop` goes over the link instead")
                return
            if self._closing:
                return
            answer = self._answer(request)
            if client:
                with suppress(OSError):  # the client is gone, or does not read
                    self._socket.sendto(answer, socket.MSG_DONTWAIT, client)

    def _answer(self, request: bytes) -> bytes:
        try:
            if request.startswith(_STOP):
                self._stop(request.removeprefix(_STOP).decode(errors="replace"))
            elif request != _STATUS:
                return _ERROR + b"bus: unknown request to the stop's socket. Use the same version on both ends."
            fields = (field.replace("\t", " ").replace("\n", " ") for field in self._read_status())
            return "\t".join(fields).encode()[:_MAX_BYTES]
        except Exception as error:  # every type: the next stop must still be served
            if not isinstance(error, HalError):
                _LOG.exception("a request to the stop's socket failed")
            return _ERROR + str(error).encode()[: _MAX_BYTES - len(_ERROR)]


class StopClient:
    """A connection to the stop's socket of this user's HAL.

    Raises:
        HalTimeoutError: this user runs no HAL of that robot and port (`no_hal`).
    """

    def __init__(self, robot: str, port: int, timeout_s: float = 1.0) -> None:
        path, self._own_path = find_file(stop_socket_name(robot, port)), None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            if path is None:
                raise FileNotFoundError(stop_socket_name(robot, port))
            self._socket.settimeout(timeout_s)
            # The answer goes to a file too: an abstract address would not reach from a container's network.
            self._own_path = path.with_name(f"answer-{os.urandom(6).hex()}")
            self._socket.bind(str(self._own_path))
            self._socket.connect(str(path))
        except OSError as err:  # no file, or one of a HAL that was killed
            self.close()
            raise HalTimeoutError(f"stop: no HAL of this user serves {robot!r} at port {port}.", code="no_hal") from err

    def stop(self, reason: str) -> StopAnswer:
        """Latch the stop and return the servo's status.

        Raises:
            HalTimeoutError: no answer (`no_answer`).
            HalError: the HAL cannot stop the arm (`stop_rejected`).
        """
        return self._request(_STOP + reason.encode()[: _MAX_BYTES - len(_STOP)])

    def read_status(self) -> StopAnswer:
        """Return the servo's status (errors as `stop`)."""
        return self._request(_STATUS)

    def _request(self, request: bytes) -> StopAnswer:
        try:
            self._socket.send(request)
            answer = self._socket.recv(_MAX_BYTES)
        except OSError as err:
            raise HalTimeoutError(
                f"stop: the HAL gave no answer on its socket ({err}). Use the switch on the arm.", code="no_answer"
            ) from err
        if answer.startswith(_ERROR):
            raise HalError(answer.removeprefix(_ERROR).decode(errors="replace"), code="stop_rejected")
        mode, reason, owner = answer.decode(errors="replace").split("\t")
        return StopAnswer(mode, reason, owner)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()
        if self._own_path is not None:
            self._own_path.unlink(missing_ok=True)
