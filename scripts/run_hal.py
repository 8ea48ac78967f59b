"""Serve an arm and a camera over Zenoh: servo at 500 Hz, limits, watchdog and stop.

    ./z1 hal --hal sim --object bottle      the digital twin
    ./z1 hal --hal wire-sim                 the twin behind the real arm's and the real camera's drivers
    ./z1 hal --hal mock                     an arm without physics, for trying clients

Stop it with Ctrl-C: it brakes, holds, and lets go.
"""

from __future__ import annotations

import logging
import os
from contextlib import ExitStack
from dataclasses import dataclass, field
from threading import Event, Thread
from typing import Annotated

import tyro

from hal.bus.session import BusConfig
from hal.guard import Workspace
from hal.process import serve, stop_on_signals
from hal.rig import RIGS, Rig

TWINS = ("sim", "wire-sim")
"""Rigs that are made of a scene."""
READY = "ready"
"""The line printed once everything answers."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Which hardware, where, and for the twin what stands on the table."""

    hal: str = "sim"
    """Which rig: `sim` is the twin, `wire-sim` the same behind the real drivers, `mock` an arm without physics."""
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
    until_stdin_closes: bool = False
    """End when standard input closes: whoever started this process and dies takes it along, after braking."""


def main(config: Config) -> int:
    """Serve until told to stop."""
    logging.basicConfig(level=logging.WARNING, format="hal: %(message)s")
    for room in ("hal", "sim_twin"):
        logging.getLogger(room).setLevel(logging.INFO)
    rig = make_rig(config)
    stop_event = Event()
    stop_on_signals(stop_event)
    if config.until_stdin_closes:
        Thread(target=_watch_stdin, args=(stop_event,), daemon=True).start()
    with ExitStack() as undo:

        def ready() -> None:
            if rig.world is not None:
                from sim_twin.truth import TruthServer

                undo.callback(TruthServer(config.bus, rig.world).close)
            print(READY, flush=True)

        serve(rig, config.bus, stop_event, on_ready=ready, workspace=config.workspace)
    return 0


def make_rig(config: Config) -> Rig:
    """Return the rig that `config` names, living by the wall clock.

    Raises:
        UnknownBackendError: no such rig.
        ValueError: the scene is out of range.
    """
    if config.hal not in TWINS:
        return RIGS.make(config.hal)
    from calibration.board import Board
    from scripts.calibration_robot import RobotOptions, make_print
    from sim_twin.scene import SceneConfig

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
    return RIGS.make(config.hal, scene=scene)


def _watch_stdin(stop_event: Event) -> None:
    while os.read(0, 4096):  # not sys.stdin: its lock, held by a daemon thread, aborts the interpreter's exit
        pass
    stop_event.set()
