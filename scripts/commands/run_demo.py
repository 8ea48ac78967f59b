"""The twin sees an object with its wrist camera and lifts it: HAL and runtime as two processes over Zenoh.

./z1 demo
./z1 demo --object box --distance-m 0.44 --lateral-m 0.1 --seed 3 --view
"""

from __future__ import annotations

import json
import logging
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console

from hal.base.clock import Stopwatch
from hal.base.errors import HalError, InvalidValueError
from hal.base.messages import ServoStatus
from hal.bus.session import BusConfig
from scripts.commands.run_hal import TWINS
from scripts.support.hal_process import HalProcess
from scripts.support.rig_option import RigOption
from sim_twin.model.scene import SceneConfig

if TYPE_CHECKING:  # planner and viewer take seconds to load: that happens beside the HAL's own start
    from scripts.support.demo_robot import DemoRobot
    from sim_twin.ground_truth import GroundTruth
    from z1_runtime.tasks.pick import Phase, PickResult, PickTask

WIRED_LEAD_S = 0.5
"""How much motion waits at the servo when the twin lives in processes of its own [s]; its watchdogs are the same."""
LIFTED_M = 0.05
"""An object at least this much higher than before counts as lifted [m]."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """What stands where, and what is written."""

    rig: Annotated[RigOption, tyro.conf.arg(name="")] = field(default_factory=RigOption)
    """Which hardware; a demo is of the twin's."""
    object: str = "bottle"
    """bottle, box or cylinder."""
    pitch_deg: float = 0.0
    """Lean of the object about the base's y axis [°]; a leaning one is held by a break-away fixture."""
    distance_m: float = 0.48
    """How far in front of the base it stands [m]."""
    lateral_m: float = 0.0
    """How far to the left [m]."""
    seed: int = 0
    """Of the camera's noise and of the grasp generator."""
    out: Path = Path("out/demo")
    """Folder for summary.json, episode.rrd, grasp.png, config.yaml and hal.log."""
    view: bool = False
    """Show everything live in Rerun."""
    lockstep: bool = False
    """One process on the twin's own clock: slower to watch, and the same figures for the same seed."""
    detector: str | None = None
    """Overrides the configuration: `tabletop`, `yolo`, or `truth` for evaluation."""
    detector_weights: Path | None = None
    """Weights for `yolo`, which it then is: .npz of ours, .pt of ultralytics, .onnx, or OpenVINO's .xml or folder."""
    crop: Literal["mask", "box"] | None = None
    """Overrides the configuration: what is cut out of the depth; `box` is the paper's."""
    calibration: Path | None = None
    """A hand-eye result; by default the newest of this camera (see `./z1 calibrate`), else the mount's drawing."""
    mount_error_m: float = 0.0
    """How far the twin's camera really sits from where the mount's drawing has it [m]."""
    mount_error_deg: float = 0.0
    """How far it is really turned [°]."""
    mount_seed: int = 0
    """Of the direction of both."""
    generator: str | None = None
    """Overrides the configuration: which grasp generator, such as `diffusion` or `union:obb_sweep+diffusion`."""
    generator_weights: Path | None = None
    """Weights for the generator that has such: GraspGen's .yml, GraspGenX's folder, or an .npz for `diffusion`."""
    config: Path | None = None
    """A YAML file of settings (see `./z1 show-config`)."""
    bus: Annotated[BusConfig, tyro.conf.arg(name="")] = field(default_factory=BusConfig)
    """Where the two processes meet."""

    def __post_init__(self) -> None:
        if self.rig.name not in TWINS:
            raise InvalidValueError(
                f"the demo knows where everything really is, so it is of the twin's: {' or '.join(TWINS)}, not "
                f"{self.rig.name}. For other hardware: ./z1 hal --hal {self.rig.name}, and beside it ./z1 run."
            )
        if self.lockstep and self.rig.name != "sim":
            raise InvalidValueError(f"--lockstep has no wire to go through; leave out --{self.rig.name}.")


def main(config: Config) -> int:
    """Run one pick; 0 only if the object was lifted."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    console = Console(highlight=False)
    config.out.mkdir(parents=True, exist_ok=True)
    for name in ("summary.json", "episode.rrd", "grasp.png"):  # a failed run leaves no old success behind
        (config.out / name).unlink(missing_ok=True)
    scene = SceneConfig(
        object=config.object,
        distance_m=config.distance_m,
        lateral_m=config.lateral_m,
        pitch_deg=config.pitch_deg,
        seed=config.seed,
        mount_error_m=config.mount_error_m,
        mount_error_deg=config.mount_error_deg,
        mount_seed=config.mount_seed,
    )
    console.print(f"[bold]{config.object}[/] at {config.distance_m:.2f} m, {config.lateral_m:+.2f} m to the left")
    summary = _identity(config)
    try:
        with ExitStack() as undo:
            start = Stopwatch()
            with console.status(
                "starting the twin, loading the planner (some seconds; half a minute the first time, to compile)"
            ):
                process = None if config.lockstep else _start_hal(config, scene, undo)
                robot, pipeline = _assemble(config, scene, process, console, undo)
            console.print(f"  {'start':<9} {1e-3 * start.lap_ms():6.2f} s")
            truth = _pick(robot, pipeline, process, summary)
    except BaseException as error:
        summary |= {"success": False, "error": str(error) or type(error).__name__}
        raise
    finally:
        if "success" in summary:
            (config.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    from sim_twin.camera.external_view import draw_picture

    (config.out / "grasp.png").write_bytes(draw_picture(scene, truth.qpos))
    _print_result(console, config, summary)
    return 0 if summary["success"] else 1


def _start_hal(config: Config, scene: SceneConfig, undo: ExitStack) -> HalProcess:
    process = HalProcess(scene, config.bus, config.out / "hal.log", config.rig.name)
    undo.callback(process.end)
    return process


def _assemble(
    config: Config, scene: SceneConfig, process: HalProcess | None, console: Console, undo: ExitStack
) -> tuple[DemoRobot, PickTask]:
    """Return the robot, claimed, and what will pick with it; `undo` takes them apart again."""
    from scripts.support.demo_robot import lockstep_robot, remote_robot
    from z1_runtime.config import load_config, save_config, with_detector, with_generator
    from z1_runtime.factory import make_grasp_selector
    from z1_runtime.perception.extrinsics import find_extrinsics
    from z1_runtime.tasks.pick import PickTask
    from z1_runtime.tasks.warm_up import warm_up_selector
    from z1_runtime.visualization.live_view import LiveView
    from z1_runtime.visualization.rerun_logger import RerunLogger

    runtime = replace(load_config(config.config), seed=config.seed, object_class=config.object)
    runtime = with_detector(runtime, config.detector, config.detector_weights, config.crop)
    runtime = with_generator(runtime, config.generator, config.generator_weights)
    if config.rig.name == "wire-sim":  # its two more processes make the way of a chunk longer, on one core up to 0.1 s
        lead_s = max(runtime.executor.lead_s, WIRED_LEAD_S)
        runtime = replace(runtime, executor=replace(runtime.executor, lead_s=lead_s))
    save_config(runtime, config.out / "config.yaml")
    mount = find_extrinsics(scene.camera_serial(), config.calibration)
    console.print(f"  {'camera':<9} {mount.origin}", soft_wrap=True)
    decider = make_grasp_selector(runtime, mount.T_flange_camera)
    warm_up_selector(decider)
    inspector = RerunLogger(config.out / "episode.rrd", live=config.view)
    undo.callback(inspector.close)
    robot = undo.enter_context(remote_robot(process, config.bus) if process else lockstep_robot(scene))
    robot.arm.claim("demo")  # given back by its disconnecting, which forgives a HAL that is gone
    if process:
        undo.enter_context(LiveView(robot.camera, robot.arm, inspector, mount.T_flange_camera))

    def say(phase: Phase) -> None:
        console.print(f"  {phase.name:<9} {phase.duration_s:6.2f} s")

    pipeline = PickTask(
        selector=decider,
        arm=robot.arm,
        camera=robot.camera,
        clock=robot.clock,
        inspector=inspector,
        config=runtime,
        on_phase=say,
    )
    return robot, pipeline


def _pick(robot: DemoRobot, pipeline: PickTask, process: HalProcess | None, summary: dict[str, Any]) -> GroundTruth:
    """Pick once, fill `summary`, and return the truth afterwards.

    Raises:
        HalError: as `PickTask.pick`; of a HAL process that has ended, its own last words.
    """
    try:
        record = pipeline.pick()
        truth = robot.truth()
        summary |= summarise(robot, record, truth)
    except HalError as error:
        if process is not None and (ended := process.why_it_ended()):
            raise HalError(ended) from error
        raise
    return truth


def _identity(config: Config) -> dict[str, Any]:
    return {
        "version": version("z1-grasp"),
        "object": config.object,
        "pitch_deg": config.pitch_deg,
        "distance_m": config.distance_m,
        "lateral_m": config.lateral_m,
        "seed": config.seed,
    }


def summarise(robot: DemoRobot, record: PickResult, truth: GroundTruth) -> dict[str, Any]:
    """Return what summary.json holds of a pick that was executed."""
    status = robot.arm.status()
    selection = record.selection
    return {
        "success": truth.lifted_m >= LIFTED_M,
        "lifted_m": round(truth.lifted_m, 6),
        "held": record.held,
        "n_object_points": len(selection.observation.object_points),
        "n_candidates": len(selection.grasps),
        "n_after_mvb": len(selection.ranked.grasps),
        "rank": selection.plan.rank,
        "rejections": record.rejections,
        "width_m": round(selection.plan.width_m, 6),
        "jaw": round(record.jaw, 6),
        "jaw_torque_nm": round(record.jaw_torque_nm, 6),
        "phase_s": {phase.name: round(phase.duration_s, 3) for phase in record.phases},
        "stage_ms": {name: round(ms, 2) for name, ms in selection.stage_ms.items()},
        "servo": _servo_figures(status),
        "zenoh": {"frame_ms_p50": round(robot.frame_ms(50), 3), "frame_ms_p99": round(robot.frame_ms(99), 3)},
    }


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
        f"{verdict}: the {config.object} is {1e3 * summary['lifted_m']:.0f} mm up; see {config.out}/grasp.png"
    )
