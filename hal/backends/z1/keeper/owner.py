"""Keeper of a driver: started with the connection, restarted if it is killed, and left to hold the arm at the end."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import stat
import subprocess
import sys
from threading import Event, Lock, Thread

from hal.backends.z1.keeper import control
from hal.backends.z1.keeper.page import Page, make_page_file
from hal.backends.z1.keeper.process import END
from hal.base.errors import HalError, LeaseError

_LOG = logging.getLogger(__name__)
_END_S = 5.0
_RESTART_S = 0.2
_MODULE = "hal.backends.z1.keeper.process"
_left: list[subprocess.Popen[bytes]] = []  # keepers that hold an arm: not waited for, and no leak to warn of


def take_over(local: tuple[str, int]) -> bool:
    """Take over the port of a keeper that holds the arm of an ended driver; return whether there was one.

    Raises:
        LeaseError: its driver still runs (`port_in_use`).
    """
    keeper = control.find(local)
    if keeper is None:
        return False
    if keeper.phase == "standby":
        raise LeaseError(
            f"Z1: port {local[0]}:{local[1]} is in use by process {keeper.owner_pid}, which commands the arm. End it "
            f"first.",
            code="port_in_use",
        )
    control.hand_over(local)
    _LOG.info("Z1: took over the arm from keeper %d", keeper.pid)
    return True


def _error_stream() -> int | None:
    """Return None for a keeper that shares this process's stderr: not a pipe, whose reader would wait for its end."""
    return subprocess.DEVNULL if stat.S_ISFIFO(os.fstat(2).st_mode) else None


class KeeperOwner:
    """The driver's side of its keeper.

    Args:
        local: address and port of the driver.
    """

    def __init__(self, local: tuple[str, int]) -> None:
        self._local = local
        self._lock = Lock()
        self._page_file = -1
        self._page: Page | None = None
        self._link = -1
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: socket.socket | None = None
        self._ready = False

    def start(self, link: int) -> None:
        """Start the process, which shares the socket `link`; it is in standby once `is_ready`."""
        self._page_file, self._link = make_page_file(), link
        self._page, self._ready = Page(self._page_file), False
        self._spawn()

    def is_ready(self) -> bool:
        """Return whether the process is in standby.

        Raises:
            HalError: it has ended instead (`keeper_failed`).
        """
        if not self._ready and self._connection is not None:
            try:
                self._ready = bool(self._connection.recv(1))
            except BlockingIOError:
                return False
            except OSError:
                self._ready = False
            if not self._ready:
                raise HalError(
                    "Z1: the keeper's process did not start; its output is above. Without it the controller lets the "
                    "arm go whenever this process is late by 2.2 s.",
                    code="keeper_failed",
                )
        return self._ready

    def record(self, command: bytes | bytearray) -> None:
        """Record a command that was sent; empty when its body is no posture."""
        if self._page is not None:
            self._page.record(command)

    @property
    def pid(self) -> int | None:
        """Process id; None when it does not run."""
        return None if self._process is None else self._process.pid

    def stop(self, *, hold: bool) -> None:
        """End the process, or leave it to hold the arm. Harmless when not started."""
        with self._lock:
            process, connection = self._process, self._connection
            self._process = self._connection = self._page = None
        if process is None or connection is None:
            return
        os.close(self._page_file)
        if hold:
            _left.append(process)
            connection.close()
            _LOG.warning(
                "Z1: process %d holds the arm from now on: without it the controller lets the arm go limp within 2.2 "
                "s, and it falls with what it holds. A new `./z1 hal --real` takes over; `./z1 release-arm` lets go "
                "of a supported arm.",
                process.pid,
            )
            return
        with contextlib.suppress(OSError):  # it was killed
            connection.sendall(END)
        connection.close()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _spawn(self) -> None:
        ours, theirs = socket.socketpair()
        config = {
            "link": self._link,
            "page": self._page_file,
            "owner": theirs.fileno(),
            "owner_pid": os.getpid(),
            "path": str(control.new_socket_path(self._local)),
        }
        process = subprocess.Popen(
            # -P: no module of the working directory takes the place of an installed one
            [sys.executable, "-P", "-m", _MODULE, json.dumps(config)],
            pass_fds=(self._link, self._page_file, theirs.fileno()),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=_error_stream(),
            start_new_session=True,  # a closed terminal must not end it
        )
        theirs.close()
        ours.setblocking(False)
        self._process, self._connection = process, ours
        Thread(target=self._supervise, args=(process,), name="Z1 keeper", daemon=True).start()

    def _supervise(self, process: subprocess.Popen[bytes]) -> None:
        process.wait()
        with self._lock:
            if self._process is not process or not self._ready:
                return
            _LOG.error("Z1: the keeper ended with code %s; it is started again", process.returncode)
            Event().wait(_RESTART_S)  # one that cannot run must not be started without a pause
            try:
                self._spawn()
            except (HalError, OSError) as error:
                _LOG.error("%s", error)
