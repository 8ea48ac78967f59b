"""Rig: one set of connected devices, an arm, a camera, and their clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hal.base.arm import Arm
from hal.base.camera import Camera
from hal.base.clock import Clock
from hal.registry import Registry

if TYPE_CHECKING:  # only a real arm is parked
    from hal.parking import Parking


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig:
    """One robot's devices, not yet connected."""

    arm: Arm
    camera: Camera
    clock: Clock
    call_every_tick: Callable[[Callable[[], None]], None] | None = None
    """In lock-step: registers a callback that the clock calls every control period while a thread sleeps on it. None on
    the wall clock, where `hal.servo.servo_thread.ServoThread` ticks."""
    independent: bool = False
    """True when arm and camera are separate devices, which can be connected at the same time."""
    park: Parking | None = None
    """Parking of the arm at the end of a HAL process; None = the arm holds its position."""
    world: Any = None
    """The simulated world behind the devices, for evaluation only; None on a real robot."""


RIGS: Registry[Rig] = Registry(
    "rig",
    {
        "mock": "hal.backends.mock_arm:make_rig",
        "real": "hal.backends.real_rig:make_rig",
        "sim": "sim_twin.backends:make_rig",
        "wire-sim": "sim_twin.drop_in.rig:make_wire_sim_rig",
    },
)
