"""Process of the keeper: small, so that no import, compiler, camera or garbage collector can delay it.

It shares the driver's socket to the controller, and outlives the driver: `python -m hal.backends.z1.keeper.process`
with its configuration as JSON.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import select
import signal
import socket
import sys
from pathlib import Path

from hal.backends.z1.keeper.control import KeeperStatus, reply
from hal.backends.z1.keeper.holding import PERIOD_S, Keeper, Phase
from hal.backends.z1.keeper.page import Page
from hal.base.clock import WallClock
from hal.z1_protocol.link import SharedLink

_FIFO_PRIORITY = 60  # below the servo and the twin
_MCL_CURRENT = 1
_REQUEST_S = 0.2  # far below the controller's 2.2 s
END = b"E"
"""Message of a driver that leaves nothing to hold."""


class KeeperProcess:
    """The process: one `Keeper`, the driver's connection, and the control socket.

    Args:
        link: descriptor of the socket to the controller.
        page: descriptor of the page.
        owner: descriptor of the connection to the driver, whose end is the driver's.
        owner_pid: process id of the driver.
        path: path of the control socket.
    """

    def __init__(self, *, link: int, page: int, owner: int, owner_pid: int, path: str) -> None:
        self._clock = WallClock()
        self._link = SharedLink(link)
        self._owner = socket.socket(fileno=owner)
        self._owner_pid, self._path = owner_pid, Path(path)
        self._keeper = Keeper(self._link, Page(page), self._clock.now_s())
        self._waiting: socket.socket | None = None  # for the end of a release

    def run(self) -> None:
        """Run until nothing is to be held."""
        self._path.unlink(missing_ok=True)
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
            old_mask = os.umask(0o177)
            listener.bind(str(self._path))
            os.umask(old_mask)
            listener.listen(4)
            identity = self._path.lstat().st_ino
            with contextlib.suppress(OSError):
                self._owner.sendall(b"R")
            try:
                self._serve(listener)
            finally:
                with contextlib.suppress(OSError):
                    if self._path.lstat().st_ino == identity:
                        self._path.unlink()
                if self._waiting is not None:
                    reply(self._waiting, self._status())

    def _serve(self, listener: socket.socket) -> None:
        keeper = self._keeper
        sources = [listener, self._owner]
        while keeper.phase is not Phase.ENDED:
            ready = select.select(sources, [], [], PERIOD_S / 2)[0]
            if self._owner in ready:
                if self._read_owner() == END:
                    return
                sources.remove(self._owner)
                keeper.end_owner(self._clock.now_s())
                _say(f"process {self._owner_pid} has ended; holding the arm (see `./z1 release-arm --help`)")
            if listener in ready and self._handle(listener.accept()[0]):
                return
            keeper.step(self._clock.now_s())
        _say(f"ends: {keeper.reason}")

    def _read_owner(self) -> bytes:
        try:
            return self._owner.recv(1)
        except OSError:  # a driver that was killed
            return b""

    def _handle(self, connection: socket.socket) -> bool:
        """Handle a request; return whether the process ends by it."""
        connection.settimeout(_REQUEST_S)
        try:
            request = connection.recv(64).decode("ascii", "replace").strip()
        except OSError:
            request = ""
        holding = self._keeper.phase is Phase.HOLDING
        if request != "status" and not holding:
            reply(connection, f"process {self._owner_pid} commands the arm. End it first.")
        elif request == "hand over":
            self._link.close()
            reply(connection, self._status())
            return True
        elif request == "release":
            self._keeper.release()
            self._waiting = connection
            return False
        else:
            reply(connection, self._status())
        connection.close()
        return False

    def _status(self) -> KeeperStatus:
        newest = self._keeper.newest
        return KeeperStatus(
            pid=os.getpid(),
            owner_pid=self._owner_pid,
            phase=self._keeper.phase,
            q=() if newest is None else tuple(float(v) for v in newest.joints.q),
            grip_nm=0.0 if newest is None else float(newest.joints.tau[-1]),
        )


def _say(text: str) -> None:
    with contextlib.suppress(OSError):  # the terminal may be closed
        os.write(2, f"z1 keeper {os.getpid()}: {text}\n".encode())


def main() -> None:
    """Run the process whose configuration is the first argument."""
    for number in (signal.SIGINT, signal.SIGHUP):  # Ctrl-C and a closed terminal end the driver, not the arm
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))
    ctypes.CDLL(None).mlockall(_MCL_CURRENT)  # where it is permitted: swapped out it would be late
    KeeperProcess(**json.loads(sys.argv[1])).run()


if __name__ == "__main__":
    main()
