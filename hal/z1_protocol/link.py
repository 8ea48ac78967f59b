"""How datagrams get to the other side of a wire and back: over UDP, or by whatever else keeps this contract."""

from __future__ import annotations

import errno
import select
import socket
from typing import Protocol

from hal.base.errors import HalError, LeaseError

_LARGEST = 2048


class DatagramLink(Protocol):
    """Datagrams to one peer and from it."""

    def open(self) -> None:
        """Take the local port.

        Raises:
            LeaseError: another process has it.
            HalError: there is no such address here.
        """
        ...

    def close(self) -> None:
        """Give the port back. Harmless when not open."""
        ...

    def send(self, data: bytes | bytearray) -> bool:
        """Send one datagram at once; False when it could not leave. Never raises."""
        ...

    def receive(self, timeout_s: float = 0.0) -> memoryview | None:
        """Return the next datagram, valid until the next call, or None when none comes in `timeout_s` [s]. Never
        raises."""
        ...

    def describe(self) -> str:
        """Say who the peer is and what is known about the way to it."""
        ...


class UdpLink:
    """A socket that hears its peer alone: the kernel drops what anybody else sends.

    Args:
        remote: address and port of the peer.
        local: address and port to listen on.
    """

    def __init__(self, remote: tuple[str, int], local: tuple[str, int]) -> None:
        self._remote = remote
        self._local = local
        self._socket: socket.socket | None = None
        self._poll = select.poll()
        self._buffer = memoryview(bytearray(_LARGEST))
        self._trouble = ""

    def open(self) -> None:
        if self._socket is not None:
            return
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            made.setblocking(False)
            made.bind(self._local)
            made.connect(self._remote)
        except OSError as error:
            made.close()
            raise self._explain(error) from error
        self._socket, self._trouble = made, ""
        self._poll.register(made, select.POLLIN)

    def close(self) -> None:
        if self._socket is not None:
            self._poll.unregister(self._socket)
            self._socket.close()
            self._socket = None

    def send(self, data: bytes | bytearray) -> bool:
        if self._socket is None:
            return False
        try:
            return self._socket.send(data) == len(data)
        except OSError as error:  # the way is closed for now; what comes of it is for the peer's silence to show
            self._note(error)
            return False

    def receive(self, timeout_s: float = 0.0) -> memoryview | None:
        if self._socket is None:
            return None
        try:
            if timeout_s > 0.0 and not self._poll.poll(1e3 * timeout_s):
                return None
            # One that is longer than the buffer is cut, and its size still wrong.
            return self._buffer[: self._socket.recv_into(self._buffer)]
        except BlockingIOError:
            return None
        except OSError as error:
            self._note(error)
            return None

    def describe(self) -> str:
        return f"{_join(self._remote)} (answers to {_join(self._local)}){self._trouble}"

    def _note(self, error: OSError) -> None:
        if error.errno == errno.ECONNREFUSED:
            self._trouble = "; the machine answers that nothing listens on that port"
        else:
            self._trouble = f"; the system says: {error.strerror}"

    def _explain(self, error: OSError) -> HalError:
        if error.errno == errno.EADDRINUSE:
            return LeaseError(
                f"port {_join(self._local)} is taken: another program talks to this controller already. End it first "
                f"(`ss -lunp 'sport = :{self._local[1]}'` names it), or give both sides another pair of ports."
            )
        return HalError(
            f"cannot talk from {_join(self._local)} to {_join(self._remote)}: {error.strerror or error}. Give the "
            f"controller's address as this machine reaches it, and a local address that is this machine's."
        )


def _join(address: tuple[str, int]) -> str:
    return f"{address[0]}:{address[1]}"
