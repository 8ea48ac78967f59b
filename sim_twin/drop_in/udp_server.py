"""The twin behind the ports of the vendor's controller, or of the arm board below it, in real time."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import select
import socket
import sys
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, Self

from hal.base.clock import Clock, WallClock
from hal.base.errors import HalError, LeaseError
from hal.base.z1 import CONTROL_PERIOD_S
from hal.z1_protocol.board import PERIOD_S
from sim_twin.drop_in.config import WireConfig

if TYPE_CHECKING:
    from sim_twin.model.world import World

log = logging.getLogger(__name__)

_FIFO_PRIORITY = 70
_MAX_CATCH_UP_S = 0.020
_MOST_AT_ONCE = 1024
# Behind the controller nothing is exchanged with the motors in between, and every wake costs more than the work.
_STEPS_AT_ONCE = {"controller": round(PERIOD_S / CONTROL_PERIOD_S), "board": 1}
_LARGEST = 2048


class WiredWorld(Protocol):
    """A simulated arm behind a wire: `controlled_world.ControlledWorld` or `motor_board.ArmBoard` of
    `sim_twin.controller`."""

    world: World
    refused: int
    """Datagrams that could not be obeyed."""
    last_refusal: str
    """Why the last one could not."""

    def hear(self, data: bytes | memoryview) -> bytes | None:
        """Obey a datagram; return what is answered at once, to whoever sent it. Never raises."""
        ...

    def tick(self) -> None:
        """Let 2 ms pass; called before each step of the world."""
        ...

    def tell(self) -> bytes | None:
        """Return what is told to the client in this period, if anything."""
        ...


class WireServer:
    """A thread that hears commands, moves the world, and answers, every 2 ms; in a `with` block, or by `start` and
    `stop`.

    As the vendor's it obeys whoever sends a command. The controller answers to one address only, which a second
    client cannot have, in those of its periods in which a command came; the board answers every single datagram at
    once. When the client is gone the arm does what it was told last. Datagrams that are no commands are counted and
    dropped.

    Args:
        twin: the arm, and what is_stable before it.
        config: where it is.
        clock: the wall's.
        on_step: called after the world has gone on, by 4 ms at most.
    """

    def __init__(
        self,
        twin: WiredWorld,
        config: WireConfig | None = None,
        clock: Clock | None = None,
        on_step: Callable[[], None] = lambda: None,
    ) -> None:
        self.twin = twin
        self.config = config or WireConfig()
        self.answers = 0
        """Answers sent."""
        self._clock = clock or WallClock()
        self._on_step = on_step
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
        host, port = self.config.host, self.config.port
        inlet = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            inlet.setblocking(False)
            inlet.bind((host, port))
        except OSError as error:
            inlet.close()
            if error.errno == errno.EADDRINUSE:
                raise LeaseError(
                    f"port {host}:{port} is taken: another {self.config.depth} runs here already "
                    f"(`ss -lunp 'sport = :{port}'` names it). End it, or choose other ports."
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
            log.exception("the twin's %s failed", self.config.depth)

    def _serve(self, inlet: socket.socket) -> None:
        deadline_s, owed = self._clock.now_s(), 0
        client = (self.config.client_host, self.config.state_port)
        while not self._end.is_set():
            self._listen(inlet, deadline_s)
            late_s = self._clock.now_s() - deadline_s
            # What is later than this is dropped: the world slows down then, and never bursts.
            deadline_s += CONTROL_PERIOD_S + max(late_s - _MAX_CATCH_UP_S, 0.0)
            owed += 1
            if owed == _STEPS_AT_ONCE[self.config.depth]:
                for _ in range(owed):
                    self.twin.tick()
                    self.twin.world.step()
                owed = 0
                self._on_step()
            self._send(inlet, self.twin.tell(), client)

    def _listen(self, inlet: socket.socket, until_s: float) -> None:
        if self.config.depth == "controller":  # what comes meanwhile is answered afterwards anyway
            self._clock.sleep_until(until_s)
        while (left_s := until_s - self._clock.now_s()) > 0.0:
            if select.select([inlet], [], [], left_s)[0]:
                self._hear(inlet)
        self._hear(inlet)

    def _hear(self, inlet: socket.socket) -> None:
        for _ in range(_MOST_AT_ONCE):
            try:
                size, sender = inlet.recvfrom_into(self._buffer)
            except BlockingIOError:
                break
            except OSError:  # an answer of before reached nobody; the next datagram is still there
                continue
            self._send(inlet, self.twin.hear(self._buffer[:size]), sender)

    def _send(self, inlet: socket.socket, data: bytes | None, to: tuple[str, int]) -> None:
        if data is None:
            return
        try:
            inlet.sendto(data, to)
            self.answers += 1
        except OSError as error:
            log.debug("an answer could not leave: %s", error)


def _hurry() -> None:
    """Ask for real time for this thread, as a controller of its own would have it; go on without what is not permitted.

    Below the servo's thread, which waits for the answers.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))
