"""See, plan and pick once, against a HAL process that runs already (`./z1 hal`).

./z1 hal --sim              in one terminal
./z1 run                    in another
"""

from __future__ import annotations

import logging
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from hal.base.clock import WallClock
from hal.bus.client import RemoteArm, RemoteCamera
from hal.bus.session import BusConfig

if TYPE_CHECKING:
    from z1_runtime.tasks.pick import PickTask


@dataclass(frozen=True, kw_only=True)
class Config:
    """Where the HAL is and how the pick is done."""

    calibration: Path | None = None
    """A hand-eye result; by default the newest of this camera (see `./z1 calibrate`), else the mount's drawing."""
    object: str = ""
    """Class to pick, such as bottle, for a detector that knows classes; empty = the configuration's."""
    detector: str | None = None
    """Overrides the configuration: `tabletop` or `yolo`."""
    detector_weights: Path | None = None
    """Weights for `yolo`, which it then is: .npz of ours, .pt of ultralytics, .onnx, or OpenVINO's .xml or folder."""
    crop: Literal["mask", "box"] | None = None
    """Overrides the configuration: what is cut out of the depth; `box` is the paper's."""
    generator: str | None = None
    """Overrides the configuration: which grasp generator, such as `diffusion` or `union:obb_sweep+diffusion`."""
    generator_weights: Path | None = None
    """Weights for the generator that has such: GraspGen's .yml, GraspGenX's folder, or an .npz for `diffusion`."""
    config: Path | None = None
    """A YAML file of settings (see `./z1 show-config`)."""
    out: Path | None = None
    """Folder for episode.rrd."""
    view: bool = False
    """Show everything live in Rerun."""
    bus: Annotated[BusConfig, tyro.conf.arg(name="")] = field(default_factory=BusConfig)
    """Where the HAL process listens."""


def main(config: Config) -> int:
    """Run one pick; 0 only if the jaws hold something afterwards."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    console = Console(highlight=False)
    with ExitStack() as undo:
        arm = RemoteArm(config.bus, "run")
        arm.connect()  # first: whoever forgot the HAL need not wait for the planner to load
        undo.callback(arm.disconnect)
        camera = RemoteCamera(config.bus)
        camera.connect()
        undo.callback(camera.disconnect)
        with console.status("loading the planner (some seconds)"):
            pipeline = _assemble(config, arm, camera, console, undo)
        arm.claim("run")  # given back by disconnecting, which forgives a HAL that is gone
        record = pipeline.pick_until_held()
    console.print("the jaws hold something" if record.held else "the jaws are empty")
    return 0 if record.held else 1


def _assemble(config: Config, arm: RemoteArm, camera: RemoteCamera, console: Console, undo: ExitStack) -> PickTask:
    """Return what picks; `undo` ends what it writes."""
    from z1_runtime.config import load_config, with_detector, with_generator
    from z1_runtime.factory import make_grasp_selector
    from z1_runtime.perception.extrinsics import find_extrinsics
    from z1_runtime.tasks.pick import PickTask
    from z1_runtime.tasks.warm_up import warm_up_selector
    from z1_runtime.visualization.live_view import LiveView
    from z1_runtime.visualization.rerun_logger import RerunLogger

    runtime = with_detector(load_config(config.config), config.detector, config.detector_weights, config.crop)
    runtime = with_generator(runtime, config.generator, config.generator_weights)
    if config.object:
        runtime = replace(runtime, object_class=config.object)
    mount = find_extrinsics(camera.wait_for_frame(runtime.frame_timeout_s).serial, config.calibration)
    console.print(f"  {'camera':<9} {mount.origin}", soft_wrap=True)
    decider = make_grasp_selector(runtime, mount.T_flange_camera)
    warm_up_selector(decider)
    inspector = RerunLogger(config.out / "episode.rrd" if config.out else None, live=config.view)
    undo.callback(inspector.close)
    if config.out or config.view:
        undo.enter_context(LiveView(camera, arm, inspector, mount.T_flange_camera))
    return PickTask(
        selector=decider,
        arm=arm,
        camera=camera,
        clock=WallClock(),
        inspector=inspector,
        config=runtime,
        on_phase=lambda phase: console.print(f"  {phase.name:<9} {phase.duration_s:6.2f} s"),
    )
