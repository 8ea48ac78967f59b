"""Trains the grasp generator and its discriminator on the CPU and writes their weights.

    python -m scripts.make_grasp_dataset
    nice -n 19 python -m scripts.train_graspgen            # goes on where it stopped; half an hour on one core
    python -m scripts.evaluate_graspgen                    # writes models/weights/graspgen_agnostic.json

Checkpoints lie in out/graspgen/. With the same data, seed, torch version and machine the weights come out the same.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
import tyro
from rich.console import Console

from models.graspgen.data import load_shards
from models.graspgen.labels import GRIPPERS
from models.graspgen.training import TrainingConfig, judge_samples, train_discriminator, train_generator
from models.graspgen.weights import save_weights, weights_path


@dataclass(frozen=True, kw_only=True)
class Config:
    """What to train, and on what."""

    gripper: str = "agnostic"
    """Which hand of `models.graspgen.labels.GRIPPERS`."""
    data: Path = Path("out/graspgen")
    """Folder that `make_grasp_dataset` wrote."""
    threads: int = 1
    """Processor threads."""
    weights: Path | None = None
    """Where the weights go; beside the shipped ones if not given."""
    training: TrainingConfig = field(default_factory=TrainingConfig)


def main(config: Config) -> None:
    """Train what is not trained yet."""
    torch.set_num_threads(config.threads)
    console = Console()
    data = load_shards(config.data / config.gripper)
    console.print(f"{len(data.family)} shapes, {len(data.clouds)} views")
    stem = config.data / config.gripper
    reporter = _Reporter(console)
    generator = train_generator(data, config.training, stem.with_suffix(".generator.pt"), reporter.named("generator"))
    gripper = GRIPPERS[config.gripper]
    judged = judge_samples(generator, data, gripper, config.training, reporter.named("judged, share valid"))
    checkpoint = stem.with_suffix(".discriminator.pt")
    discriminator = train_discriminator(
        generator,
        data,
        judged,
        config=config.training,
        checkpoint=checkpoint,
        progress=reporter.named("discriminator"),
    )
    path = config.weights or weights_path(config.gripper)
    path.parent.mkdir(parents=True, exist_ok=True)
    digest = save_weights(path, generator, discriminator)
    recipe = {"shapes": len(data.family), "views": len(data.clouds), "training": asdict(config.training)}
    recipe |= {"gripper": asdict(gripper), "torch": torch.__version__, "losses": reporter.curves}
    path.with_suffix(".recipe.json").write_text(json.dumps(recipe, indent=1) + "\n")
    console.print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB, SHA-256 {digest[:12]}…)")


class _Reporter:
    """Prints a running mean now and then, and keeps it for the recipe."""

    def __init__(self, console: Console) -> None:
        self.curves: dict[str, list[tuple[int, float]]] = {}
        self._console = console

    def named(self, name: str):
        """Return a progress function for one stage."""
        recent: list[float] = []
        curve = self.curves.setdefault(name, [])

        def report(iteration: int, value: float) -> None:
            recent.append(value)
            if iteration % 200 == 0:
                curve.append((iteration, round(sum(recent) / len(recent), 4)))
                self._console.print(name, *curve[-1])
                recent.clear()

        return report


if __name__ == "__main__":
    main(tyro.cli(Config))
