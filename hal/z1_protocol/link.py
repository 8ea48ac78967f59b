"""Datagram links to one peer: the contract, and its implementation over UDP."""

from __future__ import annotations

import errno
import select
import socket
from typing import Protocol

from hal.base.errors import HalError, LeaseError

_MAX_DATAGRAM = 2048  # ten times the largest valid one; longer ones are cut and then have a wrong size


class DatagramLink(Protocol):
    """Exchange of datagrams with one peer."""

    def open(self) -> None:
        """Bind the local port.

        Raises:
            LeaseError: another process has it.
            HalError: no such address on this machine.
        """
        ...

    def close(self) -> None:
        """Release the port. Harmless when not open."""
        ...

    def send(self, data: bytes | bytearray) -> bool:
        """Send one datagram at once; False when it could not leave. Never raises."""
        ...

    def receive(self, timeout_s: float = 0.0) -> memoryview | None:
        """Return the next datagram, valid until the next call, or None when none comes in `timeout_s` [s]. Never
        raises."""
        ...

    def describe(self) -> str:
        """Return the peer's address and the last failure of the link, as text."""
        ...

    def fileno(self) -> int | None:
        """Return the descriptor of the open socket; None without one."""
        ...


class UdpLink:
    """A UDP socket connected to its peer: the kernel drops the datagrams of all others.

    Args:
        remote: address and port of the peer.
        local: address and port to listen on.
    """

    def __init__(self, remote: tuple[str, int], local: tuple[str, int]) -> None:
        self._remote = remote
        self._local = local
        self._socket: socket.socket | None = None
        self._poll = select.poll()
        self._buffer = memoryview(bytearray(_MAX_DATAGRAM))  # reused: the servo's loop allocates nothing
        self._failure = ""

    def open(self) -> None:
        if self._socket is not None:
            return
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            opened.setblocking(False)  # the servo's tick must never wait in `recv`
            opened.bind(self._local)
            opened.connect(self._remote)
        except OSError as error:
            opened.close()
            raise self._explain(error) from error
        self._socket, self._failure = opened, ""
        self._poll.register(opened, select.POLLIN)

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
        except OSError as error:  # often passing, as while the peer restarts; its silence shows what lasts
            self._record(error)
            return False

    def receive(self, timeout_s: float = 0.0) -> memoryview | None:
        if self._socket is None:
            return None
        try:
            if timeout_s > 0.0 and not self._poll.poll(1e3 * timeout_s):
                return None
            return self._buffer[: self._socket.recv_into(self._buffer)]
        except BlockingIOError:
            return None
        except OSError as error:
            self._record(error)
            return None

    def describe(self) -> str:
        return f"{_join(self._remote)} (answers to {_join(self._local)}){self._failure}"

    def fileno(self) -> int | None:
        return None if self._socket is None else self._socket.fileno()

    def _record(self, error: OSError) -> None:
        # On a connected UDP socket this is the peer's ICMP message "port unreachable".
        if error.errno == errno.ECONNREFUSED:
            self._failure = "; that machine reports that nothing listens on the port"
        else:
            self._failure = f"; the system reports: {error.strerror}"

    def _explain(self, error: OSError) -> HalError:
        if error.errno == errno.EADDRINUSE:
            return LeaseError(
                f"Z1: port {_join(self._local)} is in use: another program talks to this controller. End it first "
                f"(`ss -lunp 'sport = :{self._local[1]}'` names it), or give both sides another pair of ports.",
                code="port_in_use",
            )
        return HalError(
            f"Z1: no link from {_join(self._local)} to {_join(self._remote)}: {error.strerror or error}. Give the "
            f"controller's address as this machine reaches it, and a local address of this machine.",
            code="address_unavailable",
        )


def _join(address: tuple[str, int]) -> str:
    return f"{address[0]}:{address[1]}"


class SharedLink(UdpLink):
    """The open UDP socket of another process, by its inherited descriptor.

    Args:
        fd: descriptor of the socket, which is connected to its peer.
    """

    def __init__(self, fd: int) -> None:
        shared = socket.socket(fileno=fd)
        super().__init__(shared.getpeername(), shared.getsockname())
        self._socket = shared
        self._poll.register(shared, select.POLLIN)
