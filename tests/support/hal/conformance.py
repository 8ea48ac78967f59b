"""Cases of the conformance suite: every registered backend, and every wrapper of one.

To add one, append to `ARM_CASES` or `CAMERA_CASES`: a name and a context manager that yields an `ArmCase` or
`CameraCase` with a device that is not connected yet.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from hal.backends.d405.session import D405CameraConfig
from hal.base.arm import Arm
from hal.base.camera import Camera
from hal.base.clock import Clock, ManualClock, WallClock
from hal.bus.client import RemoteArm, RemoteCamera
from hal.bus.server import HalServer
from hal.bus.session import BusConfig
from hal.rig import ARMS, CAMERAS, RIGS
from hal.servo.servo import Servo
from hal.servo.servo_thread import ServoThread
from sim_twin.backends import TwinClock
from sim_twin.controller.controlled_world import ControlledWorld
from sim_twin.drop_in.realsense_source import TwinSource
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.hal.twin_link import TwinLink
from tests.support.hal.z1_peer import FakeController, MemoryLink

TWIN_Z1 = "z1 over the twin"


@dataclass(frozen=True)
class ArmCase:
    """An arm under test."""

    arm: Arm
    """Not connected."""
    clock: Clock
    """Clock whose sleep advances the case."""
    prepare: Callable[[], None] = lambda: None
    """Called after connect(), before the first command; a servoed arm claims its lease here."""
    revive: Callable[[], None] = lambda: None
    """Called after stop(), before the next command; a servoed arm is re-armed and claimed here."""


@dataclass(frozen=True)
class CameraCase:
    """A camera under test."""

    camera: Camera
    """Not connected."""
    clock: Clock
    """Source of the camera's time."""


def make_backend(registry: Any, name: str) -> tuple[Any, Clock]:
    """Return a backend on a clock that needs no real time where possible, and that clock."""
    if name in ("mock", "replay"):
        clock = ManualClock(10.0)
        return registry.make(name, clock=clock), clock
    if name == "z1":
        clock = ManualClock(10.0)
        return registry.make(name, clock=clock, link=MemoryLink(FakeController(clock), clock)), clock
    device = registry.make(name)
    return device, device.clock


def make_arm(name: str) -> tuple[Any, Clock]:
    return z1_over_the_twin() if name == TWIN_Z1 else make_backend(ARMS, name)


@contextmanager
def registered_arm(name: str) -> Iterator[ArmCase]:
    arm, clock = make_arm(name)
    yield ArmCase(arm, clock)
    arm.disconnect()


class TickingClock:
    """Clock that advances in control periods and ticks the servo in each, as the twin's does."""

    def __init__(self, inner: Clock, period_s: float = 0.002) -> None:
        self._inner = inner
        self._period_s = period_s
        self.servo: Servo | None = None
        self.ticking = False

    def now_s(self) -> float:
        return self._inner.now_s()

    def sleep_until(self, t_s: float) -> None:
        while self.now_s() < t_s - 1e-9:
            if self.servo is not None and self.ticking:
                self.servo.tick()
            self._inner.sleep_until(min(self.now_s() + self._period_s, t_s))


@contextmanager
def servoed_arm(name: str) -> Iterator[ArmCase]:
    arm, inner = make_arm(name)
    clock = TickingClock(inner)
    servo = clock.servo = Servo(arm, inner)

    def prepare() -> None:
        servo.claim("conformance")
        clock.ticking = True

    def revive() -> None:
        servo.rearm()
        servo.claim("conformance")

    yield ArmCase(servo, clock, prepare, revive)
    clock.ticking = False
    servo.disconnect()


def z1_over_the_twin() -> tuple[Arm, Clock]:
    """Return the real arm's driver connected to the twin's controller, in lock-step, and the clock."""
    world = World(SceneConfig())
    twin, clock = ControlledWorld(world), TwinClock(world)
    return ARMS.make("z1", clock=clock, link=TwinLink(twin, clock)), clock


@contextmanager
def registered_camera(name: str) -> Iterator[CameraCase]:
    camera, clock = make_backend(CAMERAS, name)
    yield CameraCase(camera, clock)
    camera.disconnect()


@contextmanager
def running_hal() -> Iterator[BusConfig]:
    """Serve the mock rig on a free port, by the wall clock."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        config = BusConfig(port=probe.getsockname()[1])
    rig = RIGS.make("mock")
    servo = Servo(rig.arm, rig.clock, heartbeat_timeout_s=0.1)
    servo.connect()
    rig.camera.connect()
    with ServoThread(servo, rig.clock), HalServer(servo, rig.camera, rig.clock, config):
        yield config
    servo.disconnect()
    rig.camera.disconnect()


@contextmanager
def remote_arm() -> Iterator[ArmCase]:
    with running_hal() as config:
        arm = RemoteArm(config, owner="conformance")

        def revive() -> None:
            arm.rearm()
            arm.claim()

        yield ArmCase(arm, WallClock(), arm.claim, revive)
        arm.disconnect()


@contextmanager
def remote_camera() -> Iterator[CameraCase]:
    with running_hal() as config:
        camera = RemoteCamera(config)
        yield CameraCase(camera, WallClock())
        camera.disconnect()


@contextmanager
def d405_over_the_twin() -> Iterator[CameraCase]:
    """Yield the real camera's driver over librealsense and the twin's optics."""
    source = TwinSource(World(SceneConfig()))
    camera = CAMERAS.make("d405", config=D405CameraConfig(warm_up_s=0.1), source=source)
    yield CameraCase(camera, source.clock)
    camera.disconnect()


ARM_NAMES = (*ARMS.names(), TWIN_Z1)
ARM_CASES: list[tuple[str, Callable[[], AbstractContextManager[ArmCase]]]] = [
    *((name, partial(registered_arm, name)) for name in ARM_NAMES),
    *((f"servo over {name}", partial(servoed_arm, name)) for name in ARM_NAMES),
    ("remote", remote_arm),
]
CAMERA_CASES: list[tuple[str, Callable[[], AbstractContextManager[CameraCase]]]] = [
    *((name, partial(registered_camera, name)) for name in CAMERAS.names() if name not in ("d405", "none")),
    ("d405 over the twin", d405_over_the_twin),
    ("remote", remote_camera),
]


def drive(case: ArmCase, make_setpoint: Callable[[], Any], duration_s: float) -> np.ndarray:
    """Send a setpoint every control period for `duration_s` [s]; return the last one applied (7,)."""
    end_s = case.clock.now_s() + duration_s
    applied = None
    while case.clock.now_s() < end_s - 1e-9:
        applied = case.arm.send(make_setpoint()).q
        case.clock.sleep_until(case.clock.now_s() + 0.002)
    assert applied is not None
    return applied
