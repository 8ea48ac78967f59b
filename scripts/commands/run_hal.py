"""Serve an arm and a camera over Zenoh: servo at 500 Hz, limits, watchdog and stop.

    ./z1 hal --sim --object bottle      the digital twin
    ./z1 hal --wire-sim                 the twin behind the drivers of the real arm and the real camera
    ./z1 hal --mock                     an arm without physics, for testing clients
    ./z1 hal --real                     the Z1 and the D405
    ./z1 hal --real --readonly          the same, monitored only: nothing is commanded
    ./z1 hal --real --no-camera         the Z1 alone
    ./z1 hal --arm z1 --camera sim      the Z1 under the twin's camera, which renders its measured joints
    ./z1 hal --arm sim --camera d405    the twin's arm and the D405, which does not see it

End it with Ctrl-C: it brakes, holds, and disconnects; the real arm is folded first, and its motors are disabled.
"""

from __future__ import annotations

import logging
import os
import sys
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from threading import Event, Thread
from typing import Annotated

import tyro

from hal.backends.mixed_rig import SEARCH_S, make_mixed_rig
from hal.backends.z1.config import Z1ArmConfig, Z1Mode
from hal.bus.session import BusConfig
from hal.process import serve, stop_on_signals
from hal.rig import CAMERAS, RIGS, Rig
from hal.servo.guard import Workspace
from scripts.support.hal_process import READY, decode_options
from scripts.support.rig_option import NO_CAMERA, RigOption
from scripts.support.scene_options import SceneOptions

TWINS = ("sim", "wire-sim")
"""Rigs that simulate a scene."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Selection of the hardware, its limits, and the twin's scene."""

    rig: Annotated[RigOption, tyro.conf.arg(name="")] = field(default_factory=RigOption)
    """Selection of the hardware."""
    arm: Z1ArmConfig = field(default_factory=lambda: Z1ArmConfig(connect_timeout_s=SEARCH_S))
    """Real: address and use of the Z1's controller."""
    readonly: bool = False
    """Publish the measurements of arm and camera, and reject every command."""
    scene: Annotated[SceneOptions, tyro.conf.arg(name="")] = field(default_factory=SceneOptions)
    """Twin: the scene."""
    board: bool = False
    """Twin: a calibration board (`./z1 calibrate board`) on the table in place of the object."""
    workspace: Workspace = field(default_factory=Workspace)
    """Limits of the arm's workspace for every client."""
    bus: Annotated[BusConfig, tyro.conf.arg(name="")] = field(default_factory=BusConfig)
    """Address to listen on."""
    cpu: int | None = None
    """Core of the servo's thread, best one isolated from others (`isolcpus`); by default any."""
    until_stdin_closes: bool = False
    """End when standard input closes, so that this process brakes and ends with its parent."""
    options_from_stdin: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Read rig, scene and bus from the first line of standard input, and end when it closes (`HalProcess`)."""


def main(config: Config) -> int:
    """Serve until a signal or the end of standard input."""
    logging.basicConfig(level=logging.WARNING, format="hal: %(message)s")  # libraries: warnings only
    for package in ("hal", "sim_twin"):
        logging.getLogger(package).setLevel(logging.INFO)
    if config.options_from_stdin:
        name, scene, bus = decode_options(sys.stdin.buffer.readline())
        config = replace(config, rig=RigOption(hal=name), scene=scene, bus=bus, until_stdin_closes=True)
    rig = make_rig(config)
    stop_event, force_exit_event = Event(), Event()
    stop_on_signals(stop_event, force_exit_event)
    if config.until_stdin_closes:
        Thread(target=_watch_stdin, args=(stop_event,), daemon=True).start()
    with ExitStack() as stack:

        def ready() -> None:
            if rig.world is not None:
                from sim_twin.ground_truth import GroundTruthServer

                stack.callback(GroundTruthServer(config.bus, rig.world).close)
            print(READY, flush=True)  # `HalProcess` waits for this line

        serve(
            rig,
            config.bus,
            stop_event,
            on_ready=ready,
            workspace=config.workspace,
            cpu=config.cpu,
            force_exit_event=force_exit_event,
            monitor_only=config.readonly,
        )
    return 0


def make_rig(config: Config) -> Rig:
    """Return the rig that `config` names, on the wall clock.

    Raises:
        UnknownBackendError: no such rig.
        InvalidValueError: the scene is out of range.
    """
    rig = _make_whole_rig(config)
    return replace(rig, camera=CAMERAS.make(NO_CAMERA, clock=rig.clock)) if config.rig.no_camera else rig


def _make_whole_rig(config: Config) -> Rig:
    name, parts = config.rig.name, config.rig.parts
    # Read-only holds for the driver as well as for the servo: no datagram of it may command the arm.
    arm = replace(config.arm, mode=Z1Mode.OBSERVE) if config.readonly else config.arm
    if "sim" not in parts if parts else name not in TWINS:  # the twin is not imported
        return make_mixed_rig(*parts, z1=arm) if parts else RIGS.make(name, arm=arm)
    from calibration.board.board import Board
    from scripts.support.calibration_robot import RobotOptions, make_print

    board = make_print(RobotOptions(), Board()) if config.board else None
    scene = config.scene.to_scene(board)
    if parts:
        return make_mixed_rig(*parts, scene=scene, z1=arm)
    return RIGS.make(name, scene=scene, **({"mode": arm.mode} if name == "wire-sim" else {}))


def _watch_stdin(stop_event: Event) -> None:
    while os.read(0, 4096):  # not sys.stdin: its lock, held by a daemon thread, would abort the interpreter's exit
        pass
    stop_event.set()
