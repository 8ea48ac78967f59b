"""Trains the grasp generator and its discriminator on the CPU and writes their weights.

    python -m scripts.train.make_grasp_dataset
    nice -n 19 python -m scripts.train.train_diffusion            # goes on where it stopped; an hour on one core
    python -m scripts.train.evaluate_diffusion                    # writes models/weights/graspgen_agnostic.json
    python -m scripts.train.train_diffusion --run out/graspgen/more --start-from models/weights/graspgen_agnostic.npz

    python -m scripts.train.make_grasp_dataset --gripper z1 --shards 24
    python -m scripts.train.train_diffusion --gripper z1 --start-from models/weights/graspgen_agnostic.npz

Checkpoints lie in the run's folder. With the same data, seed, torch version and machine the weights come out the same.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
import tyro
from rich.console import Console

from models.diffusion.training.data import GraspData, load_shards
from models.diffusion.training.labelled_samples import label_samples
from models.diffusion.training.labels import GRIPPERS
from models.diffusion.training.training import (
    TrainingConfig,
    calibrate_discriminator,
    train_discriminator,
    train_generator,
)
from models.diffusion.weights import load_weights, save_weights, weights_path
from scripts.train.make_grasp_dataset import make_shard, save_shard

_REPORT_EVERY = 200


@dataclass(frozen=True, kw_only=True)
class Config:
    """What to train, and on what."""

    gripper: str = "agnostic"
    """Which hand of `models.diffusion.training.labels.GRIPPERS`."""
    data: Path = Path("out/graspgen")
    """Folder that `make_grasp_dataset` wrote."""
    run: Path = Path("out/graspgen")
    """Folder for checkpoints; give another one to start anew."""
    threads: int = 1
    """Processor threads."""
    weights: Path | None = None
    """Where the weights go; beside the shipped ones if not given."""
    start_from: Path | None = None
    """Weights whose generator is trained on, or that of another hand is tuned for this one."""
    held_back: int = 80
    """Shapes that calibrate the discriminator and that nothing was trained on."""
    held_back_seed: int = 500_000
    """Seed of those."""
    training: TrainingConfig = field(default_factory=TrainingConfig)


def main(config: Config) -> None:
    """Train what is not trained yet."""
    torch.set_num_threads(config.threads)
    console = Console()
    gripper = GRIPPERS[config.gripper]
    data = load_shards(config.data / config.gripper)
    console.print(f"{len(data.family)} shapes, {len(data.clouds)} views")
    stem = config.run / config.gripper
    stem.mkdir(parents=True, exist_ok=True)
    reporter = _Reporter(console, stem.with_suffix(".curves.json"))
    generator = train_generator(
        data,
        config.training,
        stem.with_suffix(".generator.pt"),
        reporter.named("generator"),
        symmetric=gripper.symmetric,
        start_from=load_weights(config.start_from)[0] if config.start_from else None,
    )
    labelling, seed = config.training.labelling, config.training.seed
    labelled = label_samples(
        generator,
        data,
        gripper,
        config=labelling,
        seed=seed,
        folder=stem / "labelled",
        progress=reporter.named("judged, share valid"),
    )
    discriminator = train_discriminator(
        generator,
        data,
        labelled,
        config=config.training,
        checkpoint=stem.with_suffix(".discriminator.pt"),
        progress=reporter.named("discriminator"),
        symmetric=gripper.symmetric,
    )
    fresh = _held_back(config)
    scale, offset = calibrate_discriminator(
        discriminator,
        fresh,
        label_samples(
            generator,
            fresh,
            gripper,
            config=replace(labelling, views=len(fresh.clouds), perturbed=0, simulated_fraction=0.0),
            seed=seed,
            folder=stem / "held_back" / "labelled",
            progress=reporter.named("held back, share valid"),
        ),
    )
    path = config.weights or weights_path(config.gripper)
    path.parent.mkdir(parents=True, exist_ok=True)
    digest = save_weights(path, generator, discriminator)
    recipe = {"shapes": len(data.family), "views": len(data.clouds), "training": asdict(config.training)}
    recipe |= {"start_from": _origin(config.start_from), "gripper": asdict(gripper)}
    recipe |= {
        "labels_shaken": _count_simulated(config.data / config.gripper),
        "samples_shaken": {"tried": labelled.simulated, "lost": labelled.lost},
    }
    recipe |= {"calibration": {"shapes": config.held_back, "scale": round(scale, 4), "offset": round(offset, 4)}}
    recipe |= {"torch": torch.__version__, "losses": reporter.curves}
    path.with_suffix(".recipe.json").write_text(json.dumps(recipe, indent=1) + "\n")
    console.print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB, SHA-256 {digest[:12]}…)")


def _held_back(config: Config) -> GraspData:
    """Return shapes and views of seeds that neither training nor evaluation use."""
    folder = config.data / config.gripper / "held_back"
    folder.mkdir(exist_ok=True)
    path = folder / f"{config.held_back_seed}-{config.held_back}.npz"
    if not path.exists():
        save_shard(path, make_shard(GRIPPERS[config.gripper], config.held_back_seed, config.held_back, n_views=2))
    return load_shards(folder)


def _origin(weights: Path | None) -> dict | None:
    """Return what the recipe says of weights that were started from: their name and, if it is there, their recipe."""
    if weights is None:
        return None
    path = weights.with_suffix(".recipe.json")
    return {"name": weights.name, "recipe": json.loads(path.read_text()) if path.exists() else None}


def _count_simulated(folder: Path) -> dict[str, dict[str, int]]:
    """Return how many ground-truth labels were tried in dynamics and how many were lost, by family."""
    totals: dict[str, Counter[str]] = {"tried": Counter(), "lost": Counter()}
    for path in folder.glob("*.shaken.json"):
        verdicts = json.loads(path.read_text())
        for key, total in totals.items():
            total.update(verdicts[key])
    return {key: dict(sorted(total.items())) for key, total in totals.items()}


class _Reporter:
    """Prints a running mean now and then, and keeps it for the recipe, over interruptions too."""

    def __init__(self, console: Console, path: Path) -> None:
        self.curves: dict[str, list[tuple[int, float]]] = json.loads(path.read_text()) if path.exists() else {}
        self._console = console
        self._path = path

    def named(self, name: str):
        """Return a progress function for one stage."""
        recent: list[float] = []

        def report(iteration: int, value: float) -> None:
            recent.append(value)
            if iteration % _REPORT_EVERY == 0:
                before = [(i, v) for i, v in self.curves.get(name, []) if i < iteration]
                self.curves[name] = [*before, (iteration, round(sum(recent) / len(recent), 4))]
                self._path.write_text(json.dumps(self.curves))
                self._console.print(name, *self.curves[name][-1])
                recent.clear()

        return report


if __name__ == "__main__":
    main(tyro.cli(Config))
