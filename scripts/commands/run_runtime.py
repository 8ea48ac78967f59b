"""Detect, plan and pick once, with a HAL process that is running (`./z1 hal`).

./z1 hal --sim              in one terminal
./z1 run                    in another
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from hal.bus.session import BusConfig
from scripts.support.pick_options import PickOptions, print_phase


@dataclass(frozen=True, kw_only=True)
class Config(PickOptions):
    """Address of the HAL, pick and output."""

    object: str = ""
    """Class to pick, such as bottle, for a detector that knows classes; empty = the configuration's."""
    out: Path | None = None
    """Folder for episode.rrd."""
    bus: Annotated[BusConfig, tyro.conf.arg(name="")] = field(default_factory=BusConfig)
    """Address of the HAL process."""


def main(config: Config) -> int:
    """Run one pick; return 0 only if the jaws hold an object afterwards."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    console = Console(highlight=False)
    from z1_runtime.robot import Robot

    runtime = config.runtime_config()
    if config.object:
        runtime = replace(runtime, object_class=config.object)
    robot = Robot.connect(
        config.bus,
        owner="run",
        config=runtime,
        calibration=config.calibration,
        recording=config.out / "episode.rrd" if config.out else None,
        view=config.view,
        on_phase=partial(print_phase, console),
    )
    with robot:  # connected before the planner loads, so that a missing HAL is reported at once
        console.print(f"  {'camera':<9} {robot.extrinsics.origin}", soft_wrap=True)
        with console.status("loading the planner (some seconds)"):
            robot.warm_up()
        result = robot.pick()
    console.print("the jaws hold an object" if result.held else "the jaws are empty")
    return 0 if result.held else 1
