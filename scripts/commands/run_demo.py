"""Pick of an object by the twin, from its wrist camera's frame to the lift: HAL and runtime as two processes.

./z1 demo
./z1 demo --object box --distance-m 0.44 --lateral-m 0.1 --seed 3 --view
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from hal.base.clock import Stopwatch
from hal.base.errors import HalError, InvalidValueError
from hal.base.files import atomic_write
from hal.base.messages import ServoStatus
from hal.base.output_folder import open_output
from hal.bus.session import BusConfig
from scripts.commands.run_hal import TWINS
from scripts.support.hal_process import HalProcess
from scripts.support.pick_options import PickOptions, print_phase
from scripts.support.rig_option import RigOption
from scripts.support.scene_options import SceneOptions

if TYPE_CHECKING:  # planner and viewer take seconds to load, which the HAL's own start overlaps
    from sim_twin.ground_truth import GroundTruth
    from z1_runtime.config import RuntimeConfig
    from z1_runtime.robot import Robot
    from z1_runtime.tasks.pick import PickResult

WIRED_LEAD_S = 0.5
"""Motion queued at the servo when the twin runs in its own processes [s]; they delay a chunk by up to 0.1 s on one
core. The watchdogs stay the same."""
LIFTED_M = 0.05
"""Rise of the object that counts as lifted [m]."""


@dataclass(frozen=True, kw_only=True)
class Config(PickOptions):
    """Scene, pick and output."""

    rig: Annotated[RigOption, tyro.conf.arg(name="")] = field(default_factory=RigOption)
    """Selection of the twin."""
    scene: Annotated[SceneOptions, tyro.conf.arg(name="")] = field(default_factory=SceneOptions)
    """The scene."""
    out: Path = Path("out/demo")
    """Folder for summary.json, episode.rrd, grasp.png, config.yaml and hal.log."""
    lockstep: bool = False
    """One process on the twin's own clock: slower to watch, and the same figures for the same seed."""
    bus: Annotated[BusConfig, tyro.conf.arg(name="")] = field(default_factory=BusConfig)
    """Address of the link between the two processes."""

    def __post_init__(self) -> None:
        if self.rig.name not in TWINS:
            raise InvalidValueError(
                f"demo: the rig has no ground truth ({self.rig.name}, allowed {' or '.join(TWINS)}). "
                f"For other hardware run ./z1 hal --hal {self.rig.name}, and in another terminal ./z1 run.",
                code="no_ground_truth",
            )
        if self.rig.parts is not None or self.rig.no_camera:
            raise InvalidValueError(
                f"demo: needs the whole twin (arm {self.rig.arm or 'of the rig'}, camera {self.rig.camera or 'none'}). "
                "Leave out --arm, --camera and --no-camera, or use ./z1 hal with them.",
                code="no_ground_truth",
            )
        if self.lockstep and self.rig.name != "sim":
            raise InvalidValueError(
                f"demo: lock-step has no drivers to test ({self.rig.name}, allowed sim). Leave out --{self.rig.name}.",
                code="lockstep_rig",
            )


def main(config: Config) -> int:
    """Run one pick; return 0 only if the object was lifted."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    with open_output(config.out):
        return _run(config, Console(highlight=False))


def _run(config: Config, console: Console) -> int:
    for name in ("summary.json", "episode.rrd", "grasp.png"):  # a failed run leaves no old success in place
        (config.out / name).unlink(missing_ok=True)
    scene = config.scene
    scene.to_scene()  # rejects bad options before any process starts
    console.print(f"[bold]{scene.object}[/] at {scene.distance_m:.2f} m, {scene.lateral_m:+.2f} m to the left")
    summary = _identity(scene)
    try:
        with ExitStack() as stack:
            start = Stopwatch()
            with console.status(
                "starting the twin, loading the planner (some seconds; half a minute the first time, to compile)"
            ):
                process = None if config.lockstep else _start_hal(config, stack)
                robot = stack.enter_context(_open_robot(config, process, console))
                ground_truth = _ground_truth(robot, config, stack)
            console.print(f"  {'start':<9} {1e-3 * start.lap_ms():6.2f} s")
            truth = _pick(robot, ground_truth, process, summary)
    except BaseException as error:  # Ctrl-C too leaves a summary
        summary |= {"success": False, "error": str(error) or type(error).__name__}
        raise
    finally:
        if "success" in summary:
            atomic_write(config.out / "summary.json", json.dumps(summary, indent=2) + "\n")
    from sim_twin.camera.external_view import draw_picture

    atomic_write(config.out / "grasp.png", draw_picture(scene.to_scene(), truth.qpos))
    _print_result(console, config, summary)
    return 0 if summary["success"] else 1


def _start_hal(config: Config, stack: ExitStack) -> HalProcess:
    process = HalProcess(config.scene, config.bus, config.out / "hal.log", config.rig.name)
    stack.callback(process.end)
    return process


def _open_robot(config: Config, process: HalProcess | None, console: Console) -> Robot:
    """Return the connected robot, with detector, generator and planner loaded while the HAL process starts."""
    from hal.rig import RIGS, connect_remote, connect_rig
    from z1_runtime.config import save_config
    from z1_runtime.factory import make_grasp_selector, warm_up_selector
    from z1_runtime.perception.extrinsics import find_extrinsics
    from z1_runtime.robot import Robot

    runtime = _runtime_config(config)
    save_config(runtime, config.out / "config.yaml")
    scene = config.scene.to_scene()
    extrinsics = find_extrinsics(scene.camera_serial(), config.calibration)
    console.print(f"  {'camera':<9} {extrinsics.origin}", soft_wrap=True)
    selector = make_grasp_selector(runtime, extrinsics.T_flange_camera)
    warm_up_selector(selector)
    if process is not None:  # last: the HAL process starts while the planner loads
        process.wait_ready()
    robot = Robot(
        connect_remote(config.bus, "demo") if process else connect_rig(RIGS.make("sim", scene=scene, lockstep=True)),
        config=runtime,
        extrinsics=extrinsics,
        selector=selector,
        recording=config.out / "episode.rrd",
        view=config.view,
        owner="demo",
        on_phase=partial(print_phase, console),
    )
    return robot


def _runtime_config(config: Config) -> RuntimeConfig:
    runtime = replace(config.runtime_config(), seed=config.scene.seed, object_class=config.scene.object)
    if config.rig.name != "wire-sim":  # see WIRED_LEAD_S
        return runtime
    lead_s = max(runtime.executor.lead_s, WIRED_LEAD_S)
    return replace(runtime, executor=replace(runtime.executor, lead_s=lead_s))


def _ground_truth(robot: Robot, config: Config, stack: ExitStack) -> Callable[[], GroundTruth]:
    """Return the source of the ground truth, in this process or in the HAL's."""
    from sim_twin.ground_truth import GroundTruthClient, read_ground_truth

    if robot.devices.world is not None:
        return partial(read_ground_truth, robot.devices.world)
    return stack.enter_context(GroundTruthClient(config.bus)).read


def _pick(
    robot: Robot, ground_truth: Callable[[], GroundTruth], process: HalProcess | None, summary: dict[str, Any]
) -> GroundTruth:
    """Pick once, fill `summary`, and return the ground truth afterwards.

    Raises:
        HalError: as `Robot.pick`; for a HAL process that has ended, with its own last message.
    """
    try:
        result = robot.pick(attempts=1)  # the figures are of one attempt, whatever the configuration has
        truth = ground_truth()
        summary |= summarise(robot, result, truth)
    except HalError as error:
        if process is not None and (reason := process.exit_reason()):
            raise HalError(reason, code="hal_process_ended") from error  # the cause; a broken link is its effect
        raise
    return truth


def _identity(scene: SceneOptions) -> dict[str, Any]:
    return {
        "version": version("z1-grasp"),
        "object": scene.object,
        "pitch_deg": scene.pitch_deg,
        "distance_m": scene.distance_m,
        "lateral_m": scene.lateral_m,
        "seed": scene.seed,
    }


def summarise(robot: Robot, result: PickResult, truth: GroundTruth) -> dict[str, Any]:
    """Return the content of summary.json for an executed pick."""
    selection = result.selection
    return {
        "success": truth.lifted_m >= LIFTED_M,
        "lifted_m": round(truth.lifted_m, 6),
        "held": result.held,
        "n_object_points": len(selection.observation.object_points),
        "n_candidates": len(selection.grasps),
        "n_after_mvb": len(selection.ranked.grasps),
        "rank": selection.plan.rank,
        "rejections": result.rejections,
        "width_m": round(selection.plan.width_m, 6),
        "jaw": round(result.jaw, 6),
        "jaw_torque_nm": round(result.jaw_torque_nm, 6),
        "phase_s": {phase.name: round(phase.duration_s, 3) for phase in result.phases},
        "stage_ms": {name: round(ms, 2) for name, ms in selection.stage_ms.items()},
        "servo": _servo_figures(robot.arm.status()),
        "zenoh": {f"frame_ms_p{percent}": round(_frame_ms(robot, percent), 3) for percent in (50, 99)},
    }


def _frame_ms(robot: Robot, percent: float) -> float:
    """Return a percentile of the frame latency over Zenoh [ms]; 0 in lock-step."""
    from hal.bus.remote_camera import RemoteCamera

    return robot.camera.frame_latency_ms(percent) if isinstance(robot.camera, RemoteCamera) else 0.0


def _servo_figures(status: ServoStatus) -> dict[str, float]:
    return {
        "ticks": status.ticks,
        "period_ms_p50": round(status.period_ms_p50, 4),
        "period_ms_p999": round(status.period_ms_p999, 4),
        "overruns": status.overruns,
    }


def _print_result(console: Console, config: Config, summary: dict[str, Any]) -> None:
    stages = ", ".join(f"{name} {ms:.0f}" for name, ms in summary["stage_ms"].items())
    console.print(f"  frame in, plan out (ms): {stages}", soft_wrap=True)
    verdict = "[bold green]lifted[/]" if summary["success"] else "[bold red]not lifted[/]"
    console.print(
        f"{verdict}: the {config.scene.object} is {1e3 * summary['lifted_m']:.0f} mm up; see {config.out}/grasp.png"
    )
