"""The two ways `./z1 demo` gets a robot: a HAL process over Zenoh, or everything in this process in lock-step."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from hal.arm import ServoedArm
from hal.bus.client import RemoteArm, RemoteCamera
from hal.bus.session import BusConfig
from hal.camera import Camera
from hal.clock import Clock, WallClock
from hal.errors import HalError
from hal.servo import Servo
from scripts.run_hal import READY
from sim_twin.backends import make_rig
from sim_twin.scene import SceneConfig
from sim_twin.truth import Truth, TruthClient, png, read_truth


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoRobot:
    """A connected robot in the twin, and the twin's own account of it."""

    arm: ServoedArm
    camera: Camera
    clock: Clock
    truth: Callable[[], Truth]
    """Where the object really is."""
    picture: Callable[[], bytes]
    """The scene from aside, as PNG."""
    frame_ms: Callable[[float], float]
    """A percentile of the frame latency over Zenoh [ms]; 0 in lock-step."""


@contextmanager
def lockstep_robot(scene: SceneConfig) -> Iterator[DemoRobot]:
    """Yield a robot whose time moves only while somebody waits: the same calls give the same bytes."""
    rig = make_rig(scene, lockstep=True)
    assert rig.call_every_tick is not None
    servo = Servo(rig.arm, rig.clock)
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
            truth=lambda: read_truth(rig.world),
            picture=lambda: png(rig.world.render_view(1280, 720)),
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
        evaluation = TruthClient(bus)
        undo.callback(evaluation.close)
        yield DemoRobot(
            arm=arm,
            camera=camera,
            clock=clock,
            truth=evaluation.truth,
            picture=evaluation.picture,
            frame_ms=camera.frame_latency_ms,
        )


class HalProcess:
    """A HAL process of the twin; it ends with this one, whatever happens to this one."""

    def __init__(self, scene: SceneConfig, bus: BusConfig, log: Path) -> None:
        options = {
            "object": scene.object,
            "distance-m": scene.distance_m,
            "lateral-m": scene.lateral_m,
            "pitch-deg": scene.pitch_deg,
            "seed": scene.seed,
            "robot": bus.robot,
            "port": bus.port,
        }
        arguments = [f"--{name}={value}" for name, value in options.items()]
        self._log = log
        with log.open("wb") as stderr:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "scripts.cli", "hal", "--hal=sim", "--until-stdin-closes", *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                start_new_session=True,  # Ctrl-C is for this process, which then ends that one in order
            )

    def wait_ready(self) -> None:
        """Return once the HAL answers.

        Raises:
            HalError: it ended instead; the message is its own.
        """
        assert self._process.stdout is not None
        if self._process.stdout.readline().decode().strip() != READY:
            self._process.wait()
            lines = self._log.read_text(errors="replace").splitlines()
            errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
            raise HalError(errors[-1] if errors else f"the HAL process ended at its start; see {self._log}")

    def end(self) -> None:
        """Let the HAL brake and end."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
