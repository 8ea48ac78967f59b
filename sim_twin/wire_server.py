"""The twin behind the ports of the vendor's controller, in real time."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import socket
import sys
import threading
from dataclasses import dataclass
from typing import Self

from hal.clock import Clock, WallClock
from hal.errors import HalError, LeaseError
from hal.wire.controller import COMMAND_PORT, STATE_PORT
from hal.z1 import CONTROL_PERIOD_S
from sim_twin.controlled_world import ControlledWorld

log = logging.getLogger(__name__)

_FIFO_PRIORITY = 70
_MAX_CATCH_UP_S = 0.020
_MOST_AT_ONCE = 1024
_LARGEST = 2048


@dataclass(frozen=True, slots=True, kw_only=True)
class WireConfig:
    """Where the controller is and whom it answers; another arm needs another pair of ports."""

    host: str = "127.0.0.1"
    """The address to listen on; 0.0.0.0 for all of this machine's."""
    command_port: int = COMMAND_PORT
    """The port to listen on."""
    client_host: str = "127.0.0.1"
    """The client's machine."""
    state_port: int = STATE_PORT
    """The client's port."""

    def __post_init__(self) -> None:
        for name in ("command_port", "state_port"):
            if not 0 < getattr(self, name) < 65536:
                raise ValueError(f"{name} is {getattr(self, name)}; allowed are 1 to 65535.")


class WireServer:
    """A thread that hears commands, moves the world, and answers, every 2 ms; in a `with` block, or by `start` and
    `stop`.

    As the vendor's it obeys whoever sends a command, and answers to one address only: a second client cannot have
    its port. It answers in those of its periods in which a command came, and when the client is gone the arm does
    what it was told last. Datagrams that are no commands are counted and dropped.

    Args:
        twin: the arm and its controller.
        config: where it is.
        clock: the wall's.
    """

    def __init__(self, twin: ControlledWorld, config: WireConfig | None = None, clock: Clock | None = None) -> None:
        self.twin = twin
        self.config = config or WireConfig()
        self.answers = 0
        """Answers sent."""
        self._clock = clock or WallClock()
        self._buffer = memoryview(bytearray(_LARGEST))
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._error: Exception | None = None

    def start(self) -> None:
        """Take the port and begin. Harmless when it has begun.

        Raises:
            LeaseError: another program has the port.
            HalError: there is no such address here.
        """
        if self._thread is not None:
            return
        inlet = self._open()
        self._end.clear()
        self._error = None
        self._thread = threading.Thread(target=self._run, args=(inlet,), name="twin-wire", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Give the port back; the world stands still. Harmless when it has not begun.

        Raises:
            Exception: what ended the thread before.
        """
        if self._thread is None:
            return
        self._end.set()
        self._thread.join()
        self._thread = None
        if self._error is not None:
            raise self._error

    @property
    def alive(self) -> bool:
        """Whether it answers."""
        return self._thread is not None and self._thread.is_alive()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _open(self) -> socket.socket:
        host, port = self.config.host, self.config.command_port
        inlet = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            inlet.setblocking(False)
            inlet.bind((host, port))
        except OSError as error:
            inlet.close()
            if error.errno == errno.EADDRINUSE:
                raise LeaseError(
                    f"port {host}:{port} is taken: another controller runs here already (`ss -lunp 'sport = :{port}'` "
                    f"names it). End it, or choose another pair of ports."
                ) from error
            raise HalError(
                f"cannot listen on {host}:{port}: {error.strerror or error}. Choose an address of this machine."
            ) from error
        return inlet

    def _run(self, inlet: socket.socket) -> None:
        try:
            _hurry()
            with inlet:
                self._serve(inlet)
        except Exception as error:  # of every kind: who waits for answers has to learn why there are none
            self._error = error
            log.exception("the twin's controller failed")

    def _serve(self, inlet: socket.socket) -> None:
        deadline_s = self._clock.now_s()
        while not self._end.is_set():
            self._clock.sleep_until(deadline_s)
            late_s = self._clock.now_s() - deadline_s
            # What is later than this is dropped: the world slows down then, and never bursts.
            deadline_s += CONTROL_PERIOD_S + max(late_s - _MAX_CATCH_UP_S, 0.0)
            heard = self._hear(inlet)
            self.twin.tick()
            self.twin.world.step()
            if heard:
                self._answer(inlet)

    def _hear(self, inlet: socket.socket) -> bool:
        heard = False
        for _ in range(_MOST_AT_ONCE):
            try:
                size = inlet.recv_into(self._buffer)
            except BlockingIOError:
                break
            except OSError:  # an answer of before reached nobody; the next datagram is still there
                continue
            heard |= self.twin.take(self._buffer[:size])
        return heard

    def _answer(self, inlet: socket.socket) -> None:
        try:
            inlet.sendto(self.twin.answer(), (self.config.client_host, self.config.state_port))
            self.answers += 1
        except OSError as error:
            log.debug("an answer could not leave: %s", error)


def _hurry() -> None:
    """Ask for real time for this thread, as a controller of its own would have it; go on without what is not permitted.

    Below the servo's thread, which may live in this process and waits for the answers.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))
