"""Measures the grasp generator on shapes it never saw and writes `models/weights/graspgen_<gripper>.json`.

    nice -n 19 python -m scripts.evaluate_graspgen                  # a few minutes on one core
    python -m scripts.evaluate_graspgen --generator antipodal       # the sampler without learning, to compare

Every grasp is checked against the true solid: the open hand touches nothing, both pads touch within the friction cone.
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

from hal.clock import Stopwatch
from models.antipodal import AntipodalConfig, AntipodalSampler
from models.graspgen.labels import GRIPPERS, GripperSpec, check_grasps, find_grasps
from models.graspgen.sampler import DiffusionConfig, DiffusionSampler
from models.graspgen.shapes import KNOWN_FAMILIES, UNSEEN_FAMILIES, make_shape
from models.graspgen.solids import Solid
from models.graspgen.views import ViewConfig, render_view
from models.graspgen.weights import weights_path
from models.types import GraspGenerator

_COVERAGE_M, _COVERAGE_RAD = 0.02, np.radians(25.0)
_FRONT_RAD = np.radians(35.0)
CONDITIONS = {
    "as trained": ViewConfig(occluded_share=0.0),
    "frontal, 5° elevation": ViewConfig(frontal_share=1.0, frontal_elevation_deg=(5.0, 5.0), occluded_share=0.0),
    "35 % occluded": ViewConfig(occluded_share=1.0, hidden=(0.35, 0.35)),
}
"""How the shapes are seen."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """What to measure, and how much."""

    generator: Literal["diffusion", "antipodal"] = "diffusion"
    """Which generator."""
    gripper: str = "agnostic"
    """Which hand."""
    shapes: int = 40
    """Shapes in each set."""
    samples: int = 800
    """Grasps of each view."""
    latency_threads: int = 2
    """Parts side by side when the time is measured."""
    seed: int = 900_000
    """Seed of the first shape; far from those of the training data."""
    out: Path | None = None
    """Where the figures go; beside the weights if not given."""
    diffusion: DiffusionConfig = field(default_factory=DiffusionConfig)


def main(config: Config) -> None:
    """Measure both sets under all conditions, print a table and write the figures."""
    gripper = GRIPPERS[config.gripper]
    generator: GraspGenerator
    if config.generator == "diffusion":
        generator = DiffusionSampler(config.diffusion)
    else:
        generator = AntipodalSampler(AntipodalConfig(max_width_m=0.128))
    console = Console()
    report: dict = {"generator": config.generator, "shapes": config.shapes, "samples": config.samples}
    report["latency_threads"] = config.latency_threads
    if config.generator == "diffusion":
        report["sampling"] = {k: v for k, v in asdict(config.diffusion).items() if k in ("steps", "temperature")}
        weights = config.diffusion.weights or weights_path(config.gripper)
        report["weights_sha256"] = weights.with_suffix(".sha256").read_text().split()[0]
    for name, families in (("known families", KNOWN_FAMILIES), ("unseen families", UNSEEN_FAMILIES)):
        for condition, view in CONDITIONS.items():
            clouds = [
                measure_cloud(generator, gripper, solid, points, T_camera_object=T, samples=config.samples)
                for solid, points, T in track(
                    list(draw_clouds(list(families), view, config.shapes, config.seed)),
                    description=f"{name}, {condition}",
                    console=console,
                )
            ]
            report[f"{name}, {condition}"] = summary = summarise(clouds)
            console.print(f"{name}, {condition}", {k: v for k, v in summary.items() if not isinstance(v, dict | list)})
    if config.generator == "diffusion":
        generator = DiffusionSampler(replace(config.diffusion, threads=config.latency_threads))
    report["latency"] = measure_latency(generator, config.samples)
    console.print(report["latency"])
    out = config.out or weights_path(config.gripper).with_suffix(".json")
    out.write_text(json.dumps(report, indent=1, ensure_ascii=False) + "\n")


def draw_clouds(
    families: list[str], view: ViewConfig, count: int, seed: int
) -> Iterator[tuple[Solid, np.ndarray, np.ndarray]]:
    """Yield `count` solids, families in turn, each with its visible points and T_camera_object."""
    for index in range(count):
        rng = np.random.default_rng(seed + index)
        seen = None
        while seen is None:
            solid = make_shape(families[index % len(families)], rng)
            if len(find_grasps(solid, GRIPPERS["agnostic"], rng, 400)[0]) >= 20:
                seen = render_view(solid, view, rng)
        yield solid, *seen


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloudResult:
    """What one cloud's grasps were worth, best score first."""

    family: str
    valid: np.ndarray
    """(N,) bool."""
    scores: np.ndarray
    """(N,)."""
    frontal: np.ndarray
    """(N,) bool, approach within 35° of the view ray."""
    coverage: float
    """Share of the ground truth with a valid sample close by."""
    width_errors_m: np.ndarray
    """(N,) stated minus true distance between the contacts; NaN where a pad touches nothing."""
    offsets_m: np.ndarray
    """(N,) how far off the middle the object is held."""


def measure_cloud(
    generator: GraspGenerator,
    gripper: GripperSpec,
    solid: Solid,
    points: np.ndarray,
    *,
    T_camera_object: np.ndarray,
    samples: int,
) -> CloudResult:
    """Return what `generator`'s grasps for one view are worth."""
    try:
        grasps = generator.sample(points, samples, 0)
    except ValueError:  # the antipodal sampler says so when it finds none: that is a result here
        nothing = np.zeros(0)
        return CloudResult(
            family=solid.family, valid=nothing.astype(bool), scores=nothing, frontal=nothing.astype(bool),
            coverage=0.0, width_errors_m=nothing, offsets_m=nothing,
        )  # fmt: skip
    T_object = np.linalg.inv(T_camera_object) @ grasps.T_camera_grasps
    check = check_grasps(solid, T_object, gripper)
    truth, _ = find_grasps(solid, gripper, np.random.default_rng(1))
    ray = points.mean(axis=0) / np.linalg.norm(points.mean(axis=0))
    return CloudResult(
        family=solid.family,
        valid=check.valid,
        scores=grasps.scores,
        frontal=grasps.T_camera_grasps[:, :3, 2] @ ray > np.cos(_FRONT_RAD),
        coverage=_coverage(truth[:400], T_object[check.valid]),
        width_errors_m=grasps.widths_m - check.widths_m,
        offsets_m=check.offsets_m,
    )


def _coverage(truth: np.ndarray, found: np.ndarray) -> float:
    """Return the share of `truth` (G, 4, 4) that some `found` (N, 4, 4) meets within 2 cm, and 25° about both axes."""
    gap = np.linalg.norm(truth[:, None, :3, 3] - found[None, :, :3, 3], axis=-1)
    approach = truth[:, :3, 2] @ found[:, :3, 2].T
    closing = np.abs(truth[:, :3, 1] @ found[:, :3, 1].T)
    near = (gap < _COVERAGE_M) & (approach > np.cos(_COVERAGE_RAD)) & (closing > np.cos(_COVERAGE_RAD))
    return float(near.any(axis=1).mean()) if len(found) else 0.0


def summarise(clouds: list[CloudResult]) -> dict:
    """Return means over clouds, and the discriminator's AUC and calibration over all grasps."""
    top = {f"top{k}": [c.valid[:k].mean() if len(c.valid) else 0.0 for c in clouds] for k in (100, 10, 1)}
    raw = [c.valid.mean() if len(c.valid) else 0.0 for c in clouds]
    valid, scores = np.concatenate([c.valid for c in clouds]), np.concatenate([c.scores for c in clouds])
    frontal = [c.frontal.mean() if len(c.valid) else 0.0 for c in clouds]
    frontal_valid = np.concatenate([c.valid[c.frontal] for c in clouds])
    errors = np.concatenate([np.abs(c.width_errors_m[c.valid]) for c in clouds])
    offsets = np.concatenate([np.abs(c.offsets_m[c.valid]) for c in clouds])
    families = sorted({c.family for c in clouds})
    by_family = {f: _mean([r for r, c in zip(raw, clouds, strict=True) if c.family == f]) for f in families}
    best_by_family = {
        f: _mean([t for t, c in zip(top["top1"], clouds, strict=True) if c.family == f]) for f in families
    }
    return {
        "clouds": len(clouds),
        "raw": _mean(raw),
        **{key: _mean(values) for key, values in top.items()},
        "coverage": _mean([c.coverage for c in clouds]),
        "auc": round(area_under_curve(scores, valid), 3),
        "auc_within_cloud": _mean(
            [area_under_curve(c.scores, c.valid) for c in clouds if 0 < c.valid.sum() < len(c.valid)]
        ),
        "frontal_share": _mean(frontal),
        "frontal_valid": _mean(frontal_valid),
        "clouds_with_5_frontal_valid": _mean([np.sum(c.valid & c.frontal) >= 5 for c in clouds]),
        "median_width_error_m": round(float(np.median(errors)), 4) if len(errors) else None,
        "median_offset_m": round(float(np.median(offsets)), 4) if len(offsets) else None,
        "raw_by_family": by_family,
        "top1_by_family": best_by_family,
        "calibration": calibrate(scores, valid),
    }


def area_under_curve(scores: np.ndarray, valid: np.ndarray) -> float:
    """Return the chance that a valid grasp scores above an invalid one (area under the ROC curve)."""
    ranks = np.argsort(np.argsort(scores)) + 1.0
    good, bad = valid.sum(), (~valid).sum()
    return float((ranks[valid].sum() - good * (good + 1) / 2) / (good * bad)) if good and bad else float("nan")


def calibrate(scores: np.ndarray, valid: np.ndarray) -> list[dict]:
    """Return, for ten bands of score, how many grasps fall in, their mean score and the share that is valid."""
    band = np.clip((scores * 10).astype(int), 0, 9)
    return [
        {"n": int((band == b).sum()), "score": _mean(scores[band == b]), "valid": _mean(valid[band == b])}
        for b in range(10)
        if (band == b).any()
    ]


def measure_latency(generator: GraspGenerator, samples: int) -> dict:
    """Return the time for scored samples from 2,000 points [s]."""
    angle, height = np.random.default_rng(0).uniform(size=(2, 2000))
    points = np.stack([0.03 * np.cos(np.pi * angle), 0.15 * height, 0.4 - 0.03 * np.sin(np.pi * angle)], axis=1)
    times = []
    for seed in range(12):
        watch = Stopwatch()
        generator.sample(points, samples, seed)
        times.append(1e-3 * watch.lap_ms())
    return {"median_s": round(float(np.median(times)), 4), "max_s": round(max(times[1:]), 4)}


def _mean(values) -> float:
    return round(float(np.mean(values)), 3) if len(values) else float("nan")


if __name__ == "__main__":
    main(tyro.cli(Config))
