"""Evaluate the grasp generator on shapes outside of its training data; writes `models/weights/diffusion*.json`.

    nice -n 19 python -m scripts.train.evaluate_diffusion                  # a few minutes on one core
    python -m scripts.train.evaluate_diffusion --generator antipodal       # the sampler without learning, to compare

Every grasp is checked against the solid: the open gripper touches nothing, both pads touch within the friction cone.
`raw` is the valid ratio of the generator alone; `returned` and all other ratios are of the grasps of `sample`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from hal.base.clock import Stopwatch
from models.diffusion.network import weights_path
from models.diffusion.sampler import DiffusionConfig, DiffusionSampler
from models.diffusion.training.grippers import GRIPPERS, AnyGripper
from models.diffusion.training.labels import find_grasps
from models.diffusion.training.metrics import measure_cloud, summarise
from models.diffusion.training.shapes import HELD_OUT_FAMILIES, KNOWN_FAMILIES, make_shape
from models.diffusion.training.solids import Solid
from models.diffusion.training.views import ViewConfig, render_view
from models.samplers.antipodal import AntipodalConfig, AntipodalSampler
from models.types import GraspGenerator

CONDITIONS = {
    "as trained": ViewConfig(occluded_view_ratio=0.0),
    "frontal, 5° elevation": ViewConfig(frontal_ratio=1.0, frontal_elevation_deg=(5.0, 5.0), occluded_view_ratio=0.0),
    "35 % occluded": ViewConfig(occluded_view_ratio=1.0, occluded_point_ratio=(0.35, 0.35)),
}
"""Conditions of the views."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Extent of the evaluation."""

    generator: Literal["diffusion", "antipodal"] = "diffusion"
    """Evaluated generator."""
    gripper: str = "agnostic"
    """Gripper of the weights."""
    shapes: int = 60
    """Shapes in each set; 0 measures the time alone and writes nothing."""
    samples: int = 800
    """Grasps of each view."""
    simulations: int = 4
    """Grasps of each label on a view that are simulated, under the training's conditions."""
    latency_threads: int = 2
    """Parallel parts when the latency is measured."""
    seed: int = 900_000
    """Seed of the first shape; far from those of the training data."""
    out: Path | None = None
    """File of the figures; next to the weights by default."""
    diffusion: DiffusionConfig = field(default_factory=DiffusionConfig)


def main(config: Config) -> None:
    """Evaluate both sets under all conditions, print and write the figures."""
    gripper = GRIPPERS[config.gripper]
    generator: GraspGenerator
    if config.generator == "diffusion":
        generator = DiffusionSampler(replace(config.diffusion, gripper=config.gripper))
    else:
        generator = AntipodalSampler(AntipodalConfig(max_width_m=0.128))
    console = Console()
    report: dict = {"generator": config.generator, "shapes": config.shapes, "samples": config.samples}
    report["latency_threads"] = config.latency_threads
    if config.generator == "diffusion":
        report["sampling"] = {
            k: v for k, v in asdict(config.diffusion).items() if k in ("steps", "temperature", "oversampling")
        }
        weights = config.diffusion.weights or weights_path(config.gripper)
        report["weights_sha256"] = weights.with_suffix(".sha256").read_text().split()[0]
    sets = (("known families", KNOWN_FAMILIES), ("held-out families", HELD_OUT_FAMILIES)) if config.shapes else ()
    for name, families in sets:
        for condition, view in CONDITIONS.items():
            clouds = [
                measure_cloud(
                    generator,
                    gripper,
                    solid,
                    points,
                    T_camera_object=T,
                    samples=config.samples,
                    simulations=config.simulations if view is CONDITIONS["as trained"] else 0,
                )
                for solid, points, T in track(
                    list(draw_clouds(list(families), view, config.shapes, config.seed, gripper)),
                    description=f"{name}, {condition}",
                    console=console,
                )
            ]
            report[f"{name}, {condition}"] = summary = summarise(clouds)
            console.print(f"{name}, {condition}", {k: v for k, v in summary.items() if not isinstance(v, dict | list)})
    if config.generator == "diffusion":
        generator = DiffusionSampler(replace(config.diffusion, gripper=config.gripper, threads=config.latency_threads))
    report["latency"] = measure_latency(generator, config.samples)
    console.print(report["latency"])
    if not config.shapes:
        return
    out = config.out or weights_path(config.gripper).with_suffix(".json")
    out.write_text(json.dumps(report, indent=1, ensure_ascii=False) + "\n")


def draw_clouds(
    families: list[str], view: ViewConfig, count: int, seed: int, gripper: AnyGripper = GRIPPERS["agnostic"]
) -> Iterator[tuple[Solid, np.ndarray, np.ndarray]]:
    """Yield `count` solids, families in turn, each with its visible points and T_camera_object."""
    for index in range(count):
        rng = np.random.default_rng(seed + index)
        rendered = None
        while rendered is None:
            solid = make_shape(families[index % len(families)], rng)
            if len(find_grasps(solid, gripper, rng, 400)[0]) >= 20:
                rendered = render_view(solid, view, rng)
        yield solid, *rendered


def measure_latency(generator: GraspGenerator, samples: int) -> dict:
    """Return the latency of scored samples from 2,000 points [s]."""
    angle, height = np.random.default_rng(0).uniform(size=(2, 2000))
    # The visible half of the twin's cylinder: radius 30 mm, height 150 mm.
    points = np.stack([0.03 * np.cos(np.pi * angle), 0.15 * height, 0.4 - 0.03 * np.sin(np.pi * angle)], axis=1)
    times = []
    for seed in range(12):
        watch = Stopwatch()
        generator.sample(points, samples, seed)
        times.append(1e-3 * watch.lap_ms())
    return {"median_s": round(float(np.median(times)), 4), "max_s": round(max(times[1:]), 4)}


if __name__ == "__main__":
    main(tyro.cli(Config))
