"""Serve an arm and a camera over Zenoh: servo at 500 Hz, limits, watchdog and stop.

    ./z1 hal --sim --object bottle      the digital twin
    ./z1 hal --wire-sim                 the twin behind the real arm's and the real camera's drivers
    ./z1 hal --mock                     an arm without physics, for trying clients
    ./z1 hal --real                     the Z1 and the D405
    ./z1 hal --real --readonly          the same, watched only: nothing is commanded

Stop it with Ctrl-C: it brakes, holds, and lets go; the real arm is folded first, and its motors go soft.
"""

from __future__ import annotations

import logging
import os
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from threading import Event, Thread
from typing import Annotated

import tyro

from hal.backends.real_rig import SEARCH_S
from hal.backends.z1.config import Z1ArmConfig, Z1Mode
from hal.bus.session import BusConfig
from hal.process import serve, stop_on_signals
from hal.rig import RIGS, Rig
from hal.servo.guard import Workspace
from scripts.support.hal_process import READY
from scripts.support.rig_option import RigOption

TWINS = ("sim", "wire-sim")
"""Rigs that are made of a scene."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Which hardware, where, and for the twin what stands on the table."""

    rig: Annotated[RigOption, tyro.conf.arg(name="")] = field(default_factory=RigOption)
    """Which hardware."""
    arm: Z1ArmConfig = field(default_factory=lambda: Z1ArmConfig(connect_timeout_s=SEARCH_S))
    """Real: where the Z1's controller is, and how it is used."""
    readonly: bool = False
    """Publish what arm and camera measure, and refuse to command the arm."""
    object: str = "bottle"
    """Twin: what stands on the table: bottle, box or cylinder."""
    distance_m: float = 0.48
    """Twin: how far in front of the base [m]."""
    lateral_m: float = 0.0
    """Twin: how far to the left [m]."""
    pitch_deg: float = 0.0
    """Twin: lean about the base's y axis [°]."""
    seed: int = 0
    """Twin: seed of the camera's noise."""
    mount_error_m: float = 0.0
    """Twin: how far the camera really sits from where the mount's drawing has it [m]."""
    mount_error_deg: float = 0.0
    """Twin: how far it is really turned [°]."""
    mount_seed: int = 0
    """Twin: of the direction of both."""
    board: bool = False
    """Twin: a calibration board (`./z1 calibrate board`) lies on the table instead of the object."""
    workspace: Workspace = field(default_factory=Workspace)
    """Where the arm may be, whoever commands it."""
    bus: Annotated[BusConfig, tyro.conf.arg(name="")] = field(default_factory=BusConfig)
    """Where to listen."""
    cpu: int | None = None
    """Core for the servo's thread alone, best one kept free of others (`isolcpus`); by default any."""
    until_stdin_closes: bool = False
    """End when standard input closes: whoever started this process and dies takes it along, after braking."""


def main(config: Config) -> int:
    """Serve until told to stop."""
    logging.basicConfig(level=logging.WARNING, format="hal: %(message)s")
    for room in ("hal", "sim_twin"):
        logging.getLogger(room).setLevel(logging.INFO)
    rig = make_rig(config)
    stop_event, force_exit_event = Event(), Event()
    stop_on_signals(stop_event, force_exit_event)
    if config.until_stdin_closes:
        Thread(target=_watch_stdin, args=(stop_event,), daemon=True).start()
    with ExitStack() as undo:

        def ready() -> None:
            if rig.world is not None:
                from sim_twin.ground_truth import GroundTruthServer

                undo.callback(GroundTruthServer(config.bus, rig.world).close)
            print(READY, flush=True)

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
    """Return the rig that `config` names, living by the wall clock.

    Raises:
        UnknownBackendError: no such rig.
        ValueError: the scene is out of range.
    """
    name = config.rig.name
    arm = replace(config.arm, mode=Z1Mode.OBSERVE) if config.readonly else config.arm
    if name not in TWINS:
        return RIGS.make(name, arm=arm)
    from calibration.board.board import Board
    from scripts.support.calibration_robot import RobotOptions, make_print
    from sim_twin.model.scene import SceneConfig

    scene = SceneConfig(
        board=make_print(RobotOptions(), Board()) if config.board else None,
        object=config.object,
        distance_m=config.distance_m,
        lateral_m=config.lateral_m,
        pitch_deg=config.pitch_deg,
        seed=config.seed,
        mount_error_m=config.mount_error_m,
        mount_error_deg=config.mount_error_deg,
        mount_seed=config.mount_seed,
    )
    return RIGS.make(name, scene=scene, **({"mode": arm.mode} if name == "wire-sim" else {}))


def _watch_stdin(stop_event: Event) -> None:
    while os.read(0, 4096):  # not sys.stdin: its lock, held by a daemon thread, aborts the interpreter's exit
        pass
    stop_event.set()
