"""Connected devices of one robot: a rig in this process under its own servo, or the devices of a HAL process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hal.backends.no_camera import NoCamera
from hal.base.arm import ServoedArm
from hal.base.camera import Camera
from hal.base.clock import Clock, WallClock

if TYPE_CHECKING:
    from hal.bus.session import BusConfig
    from hal.rig import Rig


@dataclass(frozen=True, slots=True, kw_only=True)
class Devices:
    """A servoed arm, a camera, and the clock of both, all connected."""

    arm: ServoedArm
    camera: Camera
    clock: Clock
    real_time: bool = True
    """False in lock-step, where time moves only while a caller sleeps on the clock."""
    world: Any = None
    """The simulated world of a rig in this process, for evaluation only."""


@contextmanager
def connect_rig(rig: Rig, *, camera: bool = True) -> Iterator[Devices]:
    """Yield the devices of `rig` under a servo with the default workspace guard; its lease is free.

    In lock-step the same calls give the same bytes; otherwise a thread of this process ticks the servo.

    Args:
        rig: not connected yet.
        camera: False leaves its connection to the caller, as a connected one holds a renderer.
    """
    from hal.servo.guard import Guard
    from hal.servo.servo import Servo

    servo = Servo(rig.arm, rig.clock, guard=Guard())
    with ExitStack() as stack:
        stack.callback(rig.camera.disconnect)
        if camera:  # first: a missing one leaves the arm as it is
            rig.camera.connect()
        servo.connect()
        stack.callback(servo.disconnect)
        if rig.follow_arm is not None:
            rig.follow_arm(servo.read_state)
        if rig.call_every_tick is not None:
            rig.call_every_tick(servo.tick)
        else:
            from hal.servo.servo_thread import ServoThread

            stack.enter_context(ServoThread(servo, rig.clock))
        yield Devices(
            arm=servo,
            camera=rig.camera,
            clock=rig.clock,
            real_time=rig.call_every_tick is None,
            world=rig.world,
        )


@contextmanager
def connect_remote(bus: BusConfig, owner: str, *, camera: bool = True) -> Iterator[Devices]:
    """Yield the devices of the HAL process at `bus`; its lease is free until `owner` claims it.

    Args:
        bus: address of the HAL process.
        owner: name of this client.
        camera: False for the arm alone, as of a HAL process without a camera.

    Raises:
        HalTimeoutError: no HAL process answers.
    """
    from hal.bus.client import RemoteArm
    from hal.bus.remote_camera import RemoteCamera

    clock = WallClock()
    # Disconnecting releases the lease, also after the HAL process has ended.
    with RemoteArm(bus, owner, clock) as arm:
        if not camera:
            yield Devices(arm=arm, camera=NoCamera(), clock=clock)
            return
        with RemoteCamera(bus, clock) as remote_camera:
            yield Devices(arm=arm, camera=remote_camera, clock=clock)
