"""The twin's time: it advances only while a caller sleeps on it."""

from __future__ import annotations

from collections.abc import Callable

from hal.base.z1 import CONTROL_PERIOD_S
from sim_twin.model.world import World


class TwinClock:
    """Lock-step: sleeping runs the physics, so an episode is a pure function of its seed. For one thread."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._ticks: list[Callable[[], None]] = []
        self._sleeping = False

    def now_s(self) -> float:
        """Return the world's time [s]."""
        return self._world.time_s

    def call_every_tick(self, function: Callable[[], None]) -> None:
        """Call `function` before each control step of a sleep, in the order of registration."""
        self._ticks.append(function)

    def sleep_until(self, t_s: float) -> None:
        """Step the world until `now_s() >= t_s`; every tick function runs before each step.

        Raises:
            RuntimeError: a tick function slept on the clock that is calling it.
        """
        if self._sleeping:
            raise RuntimeError("a function called every tick slept on the twin's clock; it must return at once.")
        self._sleeping = True
        try:
            # Times are whole steps times the period: a nanosecond forgives the caller's own rounding.
            while self._world.time_s < t_s - 1e-6 * CONTROL_PERIOD_S:
                for function in self._ticks:
                    function()
                self._world.step()
        finally:
            self._sleeping = False
