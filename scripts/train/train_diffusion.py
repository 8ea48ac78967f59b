"""Train the grasp generator and its discriminator on the CPU and write their weights.

    python -m scripts.train.make_grasp_dataset
    nice -n 19 python -m scripts.train.train_diffusion            # resumes; an hour on one core
    python -m scripts.train.evaluate_diffusion                    # writes models/weights/diffusion.json
    python -m scripts.train.train_diffusion --run out/diffusion/more --start-from models/weights/diffusion.npz

    python -m scripts.train.make_grasp_dataset --gripper z1 --shards 24
    python -m scripts.train.train_diffusion --gripper z1 --start-from models/weights/diffusion.npz

Checkpoints are in the run's folder. With the same data, seed, torch version and machine the weights come out the same.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
import tyro
from rich.console import Console

from models.diffusion.network import load_weights, save_weights, weights_path
from models.diffusion.training.data import GraspData, load_shards
from models.diffusion.training.grippers import GRIPPERS
from models.diffusion.training.labelled_samples import ProgressCallback, label_samples
from models.diffusion.training.shards import make_shard, save_shard
from models.diffusion.training.training import (
    TrainingConfig,
    calibrate_discriminator,
    train_discriminator,
    train_generator,
)

_REPORT_EVERY = 200


@dataclass(frozen=True, kw_only=True)
class Config:
    """Data, folders and settings of the training."""

    gripper: str = "agnostic"
    """Gripper of `models.diffusion.training.grippers.GRIPPERS`."""
    data: Path = Path("out/diffusion")
    """Folder that `make_grasp_dataset` wrote."""
    run: Path = Path("out/diffusion")
    """Folder for checkpoints; another one starts a new run."""
    threads: int = 1
    """Processor threads."""
    weights: Path | None = None
    """File of the weights; by default the shipped one of the gripper."""
    start_from: Path | None = None
    """Weights to continue from, of this gripper or of another one."""
    calibration_shapes: int = 80
    """Shapes outside of the training data that calibrate the discriminator."""
    calibration_seed: int = 500_000
    """Seed of those, used by neither training nor evaluation."""
    training: TrainingConfig = field(default_factory=TrainingConfig)


def main(config: Config) -> None:
    """Train the stages that are not complete, and write weights and recipe."""
    torch.set_num_threads(config.threads)
    console = Console()
    gripper = GRIPPERS[config.gripper]
    data = load_shards(config.data / config.gripper)
    console.print(f"{len(data.family)} shapes, {len(data.clouds)} views")
    stem = config.run / config.gripper
    stem.mkdir(parents=True, exist_ok=True)
    reporter = _CurveRecorder(console, stem.with_suffix(".curves.json"))
    generator = train_generator(
        data,
        config.training,
        stem.with_suffix(".generator.pt"),
        reporter.report("generator"),
        symmetric=gripper.symmetric,
        # The generator alone: the discriminator learns from samples of the new one.
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
        progress=reporter.report("labelled samples, valid ratio"),
    )
    discriminator = train_discriminator(
        generator,
        data,
        labelled,
        config=config.training,
        checkpoint=stem.with_suffix(".discriminator.pt"),
        progress=reporter.report("discriminator"),
        symmetric=gripper.symmetric,
    )
    calibration = _load_calibration_data(config)
    scale, offset = calibrate_discriminator(
        discriminator,
        calibration,
        label_samples(
            generator,
            calibration,
            gripper,
            config=replace(labelling, views=len(calibration.clouds), perturbed=0, simulated_fraction=0.0),
            seed=seed,
            folder=stem / "calibration" / "labelled",
            progress=reporter.report("calibration, valid ratio"),
        ),
    )
    path = config.weights or weights_path(config.gripper)
    path.parent.mkdir(parents=True, exist_ok=True)
    digest = save_weights(path, generator, discriminator)
    recipe = {"shapes": len(data.family), "views": len(data.clouds), "training": asdict(config.training)}
    recipe |= {"start_from": _describe_origin(config.start_from), "gripper": asdict(gripper)}
    recipe |= {
        "labels_simulated": _count_simulated(config.data / config.gripper),
        "samples_simulated": {"tried": labelled.simulated, "lost": labelled.lost},
    }
    recipe |= {
        "calibration": {"shapes": config.calibration_shapes, "scale": round(scale, 4), "offset": round(offset, 4)}
    }
    recipe |= {"torch": torch.__version__, "losses": reporter.curves}
    path.with_suffix(".recipe.json").write_text(json.dumps(recipe, indent=1) + "\n")
    console.print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB, SHA-256 {digest[:12]}…)")


def _load_calibration_data(config: Config) -> GraspData:
    """Return shapes and views of seeds that neither training nor evaluation use."""
    folder = config.data / config.gripper / "calibration"
    folder.mkdir(exist_ok=True)
    seed, count = config.calibration_seed, config.calibration_shapes
    path = folder / f"{seed}-{count}.npz"
    if not path.exists():
        save_shard(path, make_shard(GRIPPERS[config.gripper], seed, count, n_views=2))
    return load_shards(folder)


def _describe_origin(weights: Path | None) -> dict | None:
    """Return the recipe's entry for the weights to continue from: their name and, if it exists, their recipe."""
    if weights is None:
        return None
    path = weights.with_suffix(".recipe.json")
    return {"name": weights.name, "recipe": json.loads(path.read_text()) if path.exists() else None}


def _count_simulated(folder: Path) -> dict[str, dict[str, int]]:
    """Return the numbers of simulated and of lost ground-truth labels, by family."""
    totals: dict[str, Counter[str]] = {"tried": Counter(), "lost": Counter()}
    for path in folder.glob("*.simulated.json"):
        outcome = json.loads(path.read_text())
        for key, total in totals.items():
            total.update(outcome[key])
    return {key: dict(sorted(total.items())) for key, total in totals.items()}


class _CurveRecorder:
    """Recorder of running means for console and recipe, kept over interruptions."""

    def __init__(self, console: Console, path: Path) -> None:
        self.curves: dict[str, list[tuple[int, float]]] = json.loads(path.read_text()) if path.exists() else {}
        self._console = console
        self._path = path

    def report(self, name: str) -> ProgressCallback:
        """Return the progress callback of one stage."""
        recent: list[float] = []

        def record(iteration: int, value: float) -> None:
            recent.append(value)
            if iteration % _REPORT_EVERY == 0:
                # A resumed run repeats the iterations since its last checkpoint.
                before = [(i, v) for i, v in self.curves.get(name, []) if i < iteration]
                self.curves[name] = [*before, (iteration, round(sum(recent) / len(recent), 4))]
                self._path.write_text(json.dumps(self.curves))
                self._console.print(name, *self.curves[name][-1])
                recent.clear()

        return record


if __name__ == "__main__":
    main(tyro.cli(Config))
