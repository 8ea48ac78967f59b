"""The two ways `./z1 demo` gets a robot: a HAL process over Zenoh, or everything in this process in lock-step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from hal.base.arm import ServoedArm
from hal.base.camera import Camera
from hal.base.clock import Clock, WallClock
from hal.bus.client import RemoteArm, RemoteCamera
from hal.bus.session import BusConfig
from hal.servo.guard import Guard
from hal.servo.servo import Servo
from scripts.support.hal_process import HalProcess
from sim_twin.ground_truth import GroundTruth, GroundTruthClient, read_ground_truth
from sim_twin.model.scene import SceneConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoRobot:
    """A connected robot in the twin, and the twin's own account of it."""

    arm: ServoedArm
    camera: Camera
    clock: Clock
    truth: Callable[[], GroundTruth]
    """Where everything really is."""
    frame_ms: Callable[[float], float]
    """A percentile of the frame latency over Zenoh [ms]; 0 in lock-step."""


@contextmanager
def lockstep_robot(scene: SceneConfig) -> Iterator[DemoRobot]:
    """Yield a robot whose time moves only while somebody waits: the same calls give the same bytes."""
    from sim_twin.backends import make_rig  # two processes need no physics in this one

    rig = make_rig(scene, lockstep=True)
    assert rig.call_every_tick is not None
    servo = Servo(rig.arm, rig.clock, guard=Guard())
    with ExitStack() as undo:
        servo.connect()
        undo.callback(servo.disconnect)
        rig.camera.connect()
        undo.callback(rig.camera.disconnect)
        rig.call_every_tick(servo.tick)
        yield DemoRobot(
            arm=servo,
            camera=rig.camera,
            clock=rig.clock,
            truth=lambda: read_ground_truth(rig.world),
            frame_ms=lambda _: 0.0,
        )


@contextmanager
def remote_robot(process: HalProcess, bus: BusConfig) -> Iterator[DemoRobot]:
    """Yield the robot that a HAL process serves."""
    process.wait_ready()
    clock = WallClock()
    arm, camera = RemoteArm(bus, "demo", clock), RemoteCamera(bus, clock)
    with ExitStack() as undo:
        arm.connect()
        undo.callback(arm.disconnect)
        camera.connect()
        undo.callback(camera.disconnect)
        evaluation = undo.enter_context(GroundTruthClient(bus))
        yield DemoRobot(
            arm=arm,
            camera=camera,
            clock=clock,
            truth=evaluation.truth,
            frame_ms=camera.frame_latency_ms,
        )
