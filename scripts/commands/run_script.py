"""Run a script for pyrealsense2 or for the Z1's vendor module, unmodified, on the twin.

    ./z1 twin run-script --object box --frames 100 viewer.py --its-own options

In the script `import pyrealsense2` gives librealsense with the twin as its camera, and `import unitree_arm_interface`
the vendor's names for an arm in the same scene, with its own controller: no real arm is used. Where OpenCV has no
windows, their last images are written to files when the script ends.
"""

from __future__ import annotations

import atexit
import runpy
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from hal.base.clock import Clock
from hal.base.errors import CommandRejectedError, InvalidValueError, SdkMissingError
from scripts.support.script_windows import windows_as_files

if TYPE_CHECKING:
    from hal.backends.z1.arm import Z1Arm
    from hal.backends.z1.config import Z1ArmConfig
    from hal.base.d405 import FrameSource
    from hal.compat.unitree_arm_interface import UDPPort
    from sim_twin.model.scene import SceneConfig


@dataclass(frozen=True, kw_only=True)
class Config:
    """Script, scene, and course of time."""

    file: tyro.conf.Positional[Path]
    """The script; the arguments after it are passed to it."""
    object: str = "bottle"
    """Object on the table: bottle, box or cylinder."""
    distance_m: float = 0.48
    """Distance of the object in front of the base [m]."""
    lateral_m: float = 0.0
    """Offset of the object to the left [m]."""
    pitch_deg: float = 0.0
    """Tilt of the object about the base's y axis [°]."""
    start: Literal["home", "startFlat"] = "home"
    """Initial pose: home, the camera's viewpoint, or folded, as the real one is switched on."""
    seed: int = 0
    """Seed of the camera's noise."""
    lockstep: bool = False
    """Frames are made when the script waits for them, reproducibly, and the arm does not move; else the twin runs by
    the wall clock."""
    frames: int = 0
    """Number of images shown after which waitKey() returns Esc and q in turn; 0 = never."""
    windows: Path = Path("out/run-script")
    """Folder of the images of its windows."""


def main(arguments: list[str]) -> int:
    """Run the script and return its exit code."""
    # Options in front of the script are this command's, those behind it the script's own.
    end = next((i for i, argument in enumerate(arguments, start=1) if argument.endswith(".py")), len(arguments))
    config = tyro.cli(Config, prog="z1 twin run-script", description=__doc__, args=arguments[:end])
    if not config.file.is_file():
        raise InvalidValueError(f"there is no script {config.file}.", code="missing_script")
    from sim_twin.model.scene import SceneConfig

    scene = SceneConfig(
        object=config.object,
        distance_m=config.distance_m,
        lateral_m=config.lateral_m,
        pitch_deg=config.pitch_deg,
        seed=config.seed,
    )
    robot = lockstep_robot(scene) if config.lockstep else wire_robot(scene, config.start)
    with robot as clock, windows_as_files(config.windows, clock, config.frames):
        return run_program(config.file, arguments[end:])


@contextmanager
def lockstep_robot(scene: SceneConfig) -> Iterator[Clock]:
    """Substitute the vendors' modules by a lock-step camera in a static scene."""
    from sim_twin.backends import TwinClock
    from sim_twin.drop_in.realsense_source import TwinSource
    from sim_twin.model.world import World

    def reject(config: Z1ArmConfig) -> Z1Arm:
        raise CommandRejectedError(
            "with --lockstep the twin's arm does not move; leave that option out to move it.", code="lockstep"
        )

    world = World(scene)
    clock = TwinClock(world)
    with ExitStack() as undo:
        source = undo.enter_context(TwinSource(world, clock))
        source.warm_up()
        undo.enter_context(_camera(source))
        undo.enter_context(_arm(make_arm=reject))
        yield clock


@contextmanager
def wire_robot(scene: SceneConfig, start: Literal["home", "startFlat"]) -> Iterator[Clock]:
    """Substitute the vendors' modules by arm and camera of a scene in other processes, by the wall clock."""
    from hal.compat.unitree_arm_interface import UDPPort
    from scripts.commands.run_wire import start_pose
    from sim_twin.drop_in.camera_process import RemoteSource
    from sim_twin.drop_in.config import WireConfig
    from sim_twin.drop_in.process import WireProcess
    from sim_twin.drop_in.rig import free_ports

    command_port, state_port = free_ports()  # the vendor's may be in use by a real controller
    twin = WireProcess(scene, WireConfig(command_port=command_port, state_port=state_port), start_pose(start))
    atexit.register(twin.close)  # runs after the script's own exit handlers, which disconnect its arm
    twin.start()
    with ExitStack() as undo:
        source = RemoteSource(twin)
        try:
            undo.enter_context(_camera(source))
            source.warm_up()
        except SdkMissingError as missing:  # not needed by a script for the arm alone
            print(f"no camera: {missing}", file=sys.stderr)
        undo.enter_context(_arm(udp=UDPPort("127.0.0.1", command_port, state_port)))
        yield source.clock


@contextmanager
def _camera(source: FrameSource) -> Iterator[None]:
    import hal.compat.realsense as rs

    with rs.plugged(source), rs.masquerade():
        yield


@contextmanager
def _arm(*, udp: UDPPort | None = None, make_arm: Callable[[Z1ArmConfig], Z1Arm] | None = None) -> Iterator[None]:
    """Substitute `unitree_arm_interface` by ours, with the controller at `udp`, or with drivers of `make_arm`."""
    import hal.compat.unitree_arm_interface as vendor

    interface = vendor.ArmInterface
    before = interface.udp, interface.make_arm
    interface.udp, interface.make_arm = udp or before[0], staticmethod(make_arm or before[1])
    try:
        with vendor.masquerade():
            yield
    finally:
        interface.udp, interface.make_arm = before[0], staticmethod(before[1])


def run_program(file: Path, arguments: list[str]) -> int:
    """Run a script in this process as Python does, and return its exit code."""
    sys.argv = [str(file), *arguments]
    sys.path.insert(0, str(file.resolve().parent))
    try:
        runpy.run_path(str(file), run_name="__main__")
    except SystemExit as ended:
        if ended.code is None or isinstance(ended.code, int):
            return ended.code or 0
        print(ended.code, file=sys.stderr)  # as Python: any other value is printed, and the exit code is 1
        return 1
    return 0
