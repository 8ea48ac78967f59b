"""Datagram link to the twin's controller within one process, on the twin's clock."""

from __future__ import annotations

from hal.base import z1
from hal.base.clock import Clock
from sim_twin.backends import TwinClock
from sim_twin.controller.controlled_world import ControlledWorld
from tests.support.hal.z1_peer import MemoryLink


class TwinLink(MemoryLink):
    """Link whose peer answers at its own rate, unprompted; it registers the twin's ticks at its clock.

    Args:
        twin: peer.
        twin_clock: clock of its world.
        clock: clock of the other end, by default the same one.
    """

    def __init__(self, twin: ControlledWorld, twin_clock: TwinClock, clock: Clock | None = None) -> None:
        super().__init__(_Mute(), clock or twin_clock, name="the twin")
        self.twin = twin
        twin_clock.call_every_tick(twin.tick)
        twin_clock.call_every_tick(self._collect)

    def send(self, data: bytes | bytearray) -> bool:
        assert self.is_open
        for command in self.mangle(bytes(data)):
            self.twin.receive(command)
        return True

    def receive(self, timeout_s: float = 0.0) -> memoryview | None:
        end_s = self.clock.now_s() + timeout_s
        while (received := super().receive()) is None and self.clock.now_s() < end_s:
            self.clock.sleep_until(self.clock.now_s() + z1.CONTROL_PERIOD_S)
        return received

    def _collect(self) -> None:
        answer = self.twin.reply()
        if answer is not None and self.is_open:
            self._waiting.extend((self.clock.now_s() + self.latency_s, one) for one in self.mangle(answer))


class _Mute:
    def handle(self, data: bytes) -> bytes | None:
        raise AssertionError("the twin takes datagrams by `receive`")
