"""A rig is what one robot is made of: an arm, a camera, and the clock they live by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hal.base.arm import Arm
from hal.base.camera import Camera
from hal.base.clock import Clock
from hal.parking import Parking
from hal.registry import Registry


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig:
    """One robot's devices, not yet connected."""

    arm: Arm
    camera: Camera
    clock: Clock
    call_every_tick: Callable[[Callable[[], None]], None] | None = None
    """In lock-step: registers what the clock calls every control period while somebody sleeps on it. None when the
    clock is the wall's, where `hal.servo.servo_thread.ServoThread` does the calling."""
    independent: bool = False
    """Arm and camera are devices of their own, which can be connected at the same time."""
    park: Parking | None = None
    """What a HAL process does with the arm when it is told to end; None = the arm holds where it is."""
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
