"""Detect, plan and pick once, with a HAL process that is running (`./z1 hal`).

./z1 hal --sim              in one terminal
./z1 run                    in another
./z1 run --drop             the same with an object in the jaws, which is dropped
"""

from __future__ import annotations

import logging
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from hal.base.errors import StoppedError
from hal.base.messages import ServoMode
from hal.base.output_folder import open_output
from hal.bus.client import RemoteArm
from hal.bus.session import BusConfig
from scripts.support.pick_options import PickOptions, print_phase


@dataclass(frozen=True, kw_only=True)
class Config(PickOptions):
    """Address of the HAL, pick and output."""

    object: str = ""
    """Class to pick, such as bottle, for a detector that knows classes; empty = the configuration's."""
    drop: bool = False
    """Open the jaws also when they hold an object, which then falls; without it such a start is rejected."""
    out: Path | None = None
    """Folder for episode.rrd."""
    bus: Annotated[BusConfig, tyro.conf.arg(name="")] = field(default_factory=BusConfig)
    """Address of the HAL process."""


def main(config: Config) -> int:
    """Run one pick; return 0 only if the jaws hold an object afterwards.

    Raises:
        StoppedError, LeaseError, GripperLoadedError: the arm takes no pick now; nothing slow was loaded before.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    console = Console(highlight=False)
    with open_output(config.out) if config.out else nullcontext():
        if config.out:
            (config.out / "episode.rrd").unlink(missing_ok=True)  # a link there would be followed
        return _run(config, console)


def _run(config: Config, console: Console) -> int:
    check_authority(config.bus)
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
    with robot:
        robot.check_ready(drop=config.drop)  # before the planner, which takes seconds to load
        console.print(f"  {'camera':<9} {robot.extrinsics.origin}", soft_wrap=True)
        with console.status("loading the planner (some seconds)"):
            robot.warm_up()
        result = robot.pick(drop=config.drop)
    console.print("the jaws hold an object" if result.held else "the jaws are empty")
    return 0 if result.held else 1


def check_authority(bus: BusConfig) -> None:
    """Check that the HAL answers, that no stop is latched, and that the lease is free.

    Raises:
        HalTimeoutError: no HAL process answers.
        StoppedError: the stop is latched.
        LeaseError: another client owns the arm.
    """
    with RemoteArm(bus, owner="run") as arm:
        status = arm.status()
        if status.mode is ServoMode.STOPPED:
            raise StoppedError(status.reason)
        arm.claim()  # released by leaving the block
