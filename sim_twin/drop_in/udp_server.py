"""UDP server of the twin, at the ports of the vendor's controller or of the motor board below it, in real time."""

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
from sim_twin.drop_in.config import WireConfig

if TYPE_CHECKING:
    from sim_twin.model.world import World

log = logging.getLogger(__name__)

_FIFO_PRIORITY = 70  # below the servo's thread, which waits for the answers
_MAX_CATCH_UP_S = 0.020
_MAX_DATAGRAMS = 1024
_MAX_DATAGRAM = 2048  # ten times the largest valid one


class ArmEndpoint(Protocol):
    """A simulated arm that exchanges datagrams: `controlled_world.ControlledWorld` or `motor_board.MotorBoard` of
    `sim_twin.controller`."""

    world: World

    @property
    def invalid_datagrams(self) -> int:
        """Datagrams that could not be decoded."""
        ...

    @property
    def invalid_reason(self) -> str:
        """Reason for the last one."""
        ...

    def receive(self, data: bytes | memoryview) -> bytes | None:
        """Process or queue a datagram; return the immediate answer to its sender, if any. Never raises."""
        ...

    def tick(self) -> None:
        """Advance by 2 ms; called before each step of the world."""
        ...

    def reply(self) -> bytes | None:
        """Return the answer to the client in this period, if any."""
        ...


class WireServer:
    """Server thread that receives commands, steps the world and answers every 2 ms; a context manager.

    As the vendor's it has no access control. The controller answers to one address only, which a second client cannot
    have, once a cycle while datagrams arrive, and at 10 Hz without any; the motor board answers every single datagram
    at once. Invalid datagrams are counted.

    Args:
        twin: arm behind the protocol.
        config: addresses.
        clock: the wall clock.
        on_step: called after each step of the world.
    """

    def __init__(
        self,
        twin: ArmEndpoint,
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
        self._buffer = memoryview(bytearray(_MAX_DATAGRAM))
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._error: Exception | None = None

    def start(self) -> None:
        """Bind the port and start the thread. Harmless when started.

        Raises:
            LeaseError: another program has the port.
            HalError: no such address on this machine.
        """
        if self._thread is not None:
            return
        inlet = self._open()
        self._end.clear()
        self._error = None
        self._thread = threading.Thread(target=self._run, args=(inlet,), name="twin-wire", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread and release the port; the world pauses. Harmless when not started.

        Raises:
            Exception: the failure that ended the thread before.
        """
        if self._thread is None:
            return
        self._end.set()
        self._thread.join()
        self._thread = None
        if self._error is not None:
            raise self._error

    @property
    def running(self) -> bool:
        """Whether the thread runs."""
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
            # `_receive` reads until nothing is left in the queue
            inlet.setblocking(False)
            inlet.bind((host, port))
        except OSError as error:
            inlet.close()
            if error.errno == errno.EADDRINUSE:
                raise LeaseError(
                    f"twin: port {host}:{port} is in use: another {self.config.depth} runs on this machine "
                    f"(`ss -lunp 'sport = :{port}'` names it). End it, or choose other ports.",
                    code="port_in_use",
                ) from error
            raise HalError(
                f"twin: cannot listen on {host}:{port}: {error.strerror or error}. Choose an address of this machine.",
                code="address_unavailable",
            ) from error
        return inlet

    def _run(self, inlet: socket.socket) -> None:
        try:
            _request_real_time()
            with inlet:
                self._serve(inlet)
        except Exception as error:  # any failure ends the thread: `stop` raises it for the owner
            self._error = error
            log.exception("the twin's %s failed", self.config.depth)

    def _serve(self, inlet: socket.socket) -> None:
        deadline_s = self._clock.now_s()
        client = (self.config.client_host, self.config.state_port)
        while not self._end.is_set():
            self._receive_until(inlet, deadline_s)
            late_s = self._clock.now_s() - deadline_s
            # A delay beyond the limit is dropped: the world then slows down, and never bursts.
            deadline_s += CONTROL_PERIOD_S + max(late_s - _MAX_CATCH_UP_S, 0.0)
            self.twin.tick()
            self._send(inlet, self.twin.reply(), client)
            self.twin.world.step()
            self._on_step()

    def _receive_until(self, inlet: socket.socket, until_s: float) -> None:
        if self.config.depth == "controller":  # it reads its queue in its next cycle only
            self._clock.sleep_until(until_s)
        while (left_s := until_s - self._clock.now_s()) > 0.0:
            if select.select([inlet], [], [], left_s)[0]:
                self._receive(inlet)
        self._receive(inlet)

    def _receive(self, inlet: socket.socket) -> None:
        # Bounded, so that a flood of datagrams does not keep the world from its step
        for _ in range(_MAX_DATAGRAMS):
            try:
                size, sender = inlet.recvfrom_into(self._buffer)
            except BlockingIOError:
                break
            except OSError:  # an earlier answer was undeliverable; the next datagram is still queued
                continue
            self._send(inlet, self.twin.receive(self._buffer[:size]), sender)

    def _send(self, inlet: socket.socket, data: bytes | None, to: tuple[str, int]) -> None:
        if data is None:
            return
        try:
            inlet.sendto(data, to)
            self.answers += 1
        except OSError as error:
            log.debug("an answer could not be sent: %s", error)


def _request_real_time() -> None:
    """Request real-time scheduling for this thread, as a controller's own computer has it, where it is permitted."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))
