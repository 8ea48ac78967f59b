"""Records one lock-step pick as an animated picture: the scene from outside, and the wrist camera with its results.

    python -m scripts.docs.record_demo                  # writes docs/images/demo.webp

The pick is that of `./z1 demo --lockstep`: the same seed gives the same motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import mujoco
import numpy as np
import tyro
from PIL import Image

from hal.base import z1
from hal.rig import Devices, connect_rig
from scripts.docs.wrist_overlay import Layers, draw_caption, draw_mask, draw_overlay
from sim_twin.backends import TwinClock, make_rig
from sim_twin.camera import d405
from sim_twin.camera.external_view import render_external
from sim_twin.camera.render import make_renderer
from sim_twin.model.scene import SceneConfig, build_model
from z1_runtime.config import load_config
from z1_runtime.factory import make_grasp_selector, warm_up_selector
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.tasks.pick import PickResult, PickTask
from z1_runtime.visualization.rerun_logger import RerunLogger

_SIZE = (480, 360)
"""Width and height of each half [px]; both together have the 960 px of a README's column."""
_MAX_BYTES = 3_000_000
_STILL_FRAMES = 6
"""Frames for each result of the decision, which takes no time on the twin's clock."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Scene and output of the recording."""

    object: str = "bottle"
    """Object on the table: bottle, box or cylinder."""
    seed: int = 0
    """Seed of the camera's noise and of the grasp generator."""
    rate_hz: float = 10.0
    """Frames in a second of the twin's time."""
    speedup: float = 1.25
    """Ratio of the picture's speed to the twin's."""
    quality: int = 80
    """WebP quality, 0 to 100."""
    out: Path = Path("docs/images/demo.webp")
    """The animated WebP."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Snapshot:
    """The twin at one moment."""

    t_s: float
    qpos: np.ndarray
    """(14,) MuJoCo's positions."""
    q: np.ndarray
    """(7,) joint positions [rad]."""


def main(config: Config) -> int:
    """Record, draw and write; 1 if the object was not held."""
    scene = SceneConfig(object=config.object, seed=config.seed)
    result, snapshots = record_pick(scene, config)
    frames = draw_frames(scene, result, snapshots)
    write_webp(frames, config)
    size = config.out.stat().st_size
    print(f"{config.out}: {len(frames)} frames, {1e-6 * size:.2f} MB, held: {result.held}")
    return 0 if result.held and size < _MAX_BYTES else 1


def record_pick(scene: SceneConfig, config: Config) -> tuple[PickResult, list[Snapshot]]:
    """Return the result of one pick in lock-step, and the twin's states `rate_hz` times a second."""
    runtime = replace(load_config(), seed=config.seed, object_class=config.object)
    selector = make_grasp_selector(runtime)
    warm_up_selector(selector)
    snapshots: list[Snapshot] = []
    with connect_rig(make_rig(scene, lockstep=True)) as robot:
        assert isinstance(robot.clock, TwinClock)
        robot.clock.call_every_tick(lambda: _record(robot, snapshots, 1.0 / config.rate_hz))
        robot.arm.claim("recording")
        task = PickTask(
            selector=selector,
            arm=robot.arm,
            camera=robot.camera,
            clock=robot.clock,
            logger=RerunLogger(),
            config=runtime,
        )
        return task.pick(), snapshots


def draw_frames(scene: SceneConfig, result: PickResult, snapshots: Sequence[Snapshot]) -> list[Image.Image]:
    """Return the frames: both views for each snapshot, and before the transfer the results one by one."""
    model = build_model(scene)
    data = mujoco.MjData(model)
    renderer = make_renderer(model, d405.INTRINSICS)
    kinematics, selection = Kinematics(), result.selection
    # The decision comes right before it, and takes no time on the twin's clock.
    transfer_s = next(phase.start_s for phase in result.phases if phase.name == "transfer")
    frames: list[Image.Image] = []
    try:
        for number, snapshot in enumerate(snapshots):
            data.qpos[:] = snapshot.qpos
            mujoco.mj_forward(model, data)
            outside = render_external(model, data, *_SIZE)
            if snapshot.t_s >= transfer_s and snapshots[number - 1].t_s < transfer_s:
                frames += _decision_frames(outside, result)
            colour = d405.measure_colour(renderer.render(data).colour, scene.seed, number)
            layers = Layers()
            if snapshot.t_s >= transfer_s:
                T_base_camera = kinematics.flange(snapshot.q[: z1.N_ARM]) @ scene.T_flange_camera()
                layers = Layers(chosen=_phase_at(result, snapshot.t_s) in ("transfer", "approach"))
                colour = draw_overlay(colour, T_base_camera, d405.INTRINSICS, selection, layers)
            frames.append(_join(outside, colour, _phase_at(result, snapshot.t_s)))
    finally:
        renderer.close()
    return frames


def write_webp(frames: Sequence[Image.Image], config: Config) -> None:
    """Write `frames` as an endless animation whose last frame stays for 1.5 s."""
    config.out.parent.mkdir(parents=True, exist_ok=True)
    period_ms = round(1000.0 / config.rate_hz / config.speedup)
    durations = [period_ms] * (len(frames) - 1) + [1500]
    frames[0].save(
        config.out,
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        loop=0,
        quality=config.quality,
        method=6,  # the slowest and smallest of Pillow's
        minimize_size=True,
    )


def _record(robot: Devices, snapshots: list[Snapshot], period_s: float) -> None:
    t_s = robot.clock.now_s()
    # The tolerance covers the rounding of the clock's sum of periods.
    if not snapshots or t_s >= snapshots[-1].t_s + period_s - 1e-6:
        # A copy of the positions, which MuJoCo changes in place.
        snapshots.append(Snapshot(t_s=t_s, qpos=robot.world.data.qpos.copy(), q=robot.arm.read_state().q))


def _decision_frames(outside: np.ndarray, result: PickResult) -> list[Image.Image]:
    """Return the results of the stages on the frame that they were computed from."""
    selection = result.selection
    observation, T = selection.observation, selection.observation.T_base_camera
    colour, found = observation.frame.colour, observation.detection
    n_kept, n_all = len(selection.ranked), len(selection.grasps)
    stages = [
        ("detect", draw_mask(colour, found.mask, found.box_px), f"detect: {found.label} {found.confidence:.2f}"),
        ("cloud", _overlay(colour, T, result, Layers(points=True)), f"cloud: {len(observation.object_points)} points"),
        ("box", _overlay(colour, T, result, Layers(points=True, box=True)), "box: nearest faces"),
        ("rank", _overlay(colour, T, result, Layers(box=True, ranked=True)), f"rank: {n_kept} of {n_all} grasps"),
        ("plan", _overlay(colour, T, result, Layers(box=True, chosen=True)), f"plan: rank {selection.plan.rank}"),
    ]
    return [_join(outside, picture, text) for _, picture, text in stages for _ in range(_STILL_FRAMES)]


def _overlay(colour: np.ndarray, T_base_camera: np.ndarray, result: PickResult, layers: Layers) -> np.ndarray:
    return draw_overlay(colour, T_base_camera, d405.INTRINSICS, result.selection, layers)


def _phase_at(result: PickResult, t_s: float) -> str:
    """Return the name of the phase at `t_s`."""
    return [phase.name for phase in result.phases if phase.start_s <= t_s + 1e-6][-1]  # rounding, as in `_record`


def _join(outside: np.ndarray, wrist: np.ndarray, text: str) -> Image.Image:
    wrist = cv2.resize(wrist, _SIZE, interpolation=cv2.INTER_AREA)
    halves = [draw_caption(outside, "twin"), draw_caption(wrist, f"wrist camera | {text}")]
    return Image.fromarray(np.hstack(halves))


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Config, description=__doc__)))
