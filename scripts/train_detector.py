"""Trains the detector on the CPU, from scratch, and writes its weights.

    python -m scripts.make_detection_dataset
    nice -n 5 python -m scripts.train_detector       # goes on where it stopped
    python -m scripts.evaluate_detector              # writes models/weights/detector.json and a picture

Checkpoints and logs lie in out/detector/run. Three phases at growing picture sizes, see `models.detector_training`.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

from models.detector_weights import WEIGHTS_FOLDER
from sim_twin.detection_props import CLASSES


@dataclass(frozen=True, kw_only=True)
class Config:
    """What to train on, and with how much of the machine."""

    data: Path = Path("out/detector/data")
    """Folder that `make_detection_dataset` wrote."""
    run: Path = Path("out/detector/run")
    """Folder for checkpoints; give another one to start anew."""
    threads: int = 1
    """Processor threads."""
    seed: int = 0
    """Of weights, order and augmentation."""
    weights: Path = WEIGHTS_FOLDER / "detector.npz"
    """Where the weights go."""


def main(config: Config) -> None:
    """Train what is not trained yet, and write the weights."""
    from models.detector_training import ARCHITECTURE, AUGMENTATION, CARD_SHARE, PHASES, read_checkpoint, train_phase
    from models.detector_weights import save_detector

    manifest = config.data / "data.yaml"
    if not manifest.is_file():
        raise FileNotFoundError(f"{manifest} is missing; make it with `python -m scripts.make_detection_dataset`.")
    checkpoint = None
    for number, phase in enumerate(PHASES):
        folder = (config.run / f"{number}_{phase.imgsz}").resolve()
        checkpoint = train_phase(
            phase, data=manifest, folder=folder, start=checkpoint, seed=config.seed, threads=config.threads
        )
    assert checkpoint is not None
    digest = save_detector(config.weights, read_checkpoint(checkpoint), CLASSES)
    recipe = {"architecture": ARCHITECTURE, "seed": config.seed, "phases": [asdict(phase) for phase in PHASES]}
    recipe |= {
        "augmentation": AUGMENTATION | {"card": CARD_SHARE},
        "data": json.loads((config.data / "recipe.json").read_text()),
    }
    recipe |= {"losses": _read_losses(config.run), "versions": _versions()}
    config.weights.with_suffix(".recipe.json").write_text(json.dumps(recipe, indent=1) + "\n")
    print(f"wrote {config.weights} ({config.weights.stat().st_size / 1e6:.1f} MB, SHA-256 {digest[:12]}…)")


def _read_losses(run: Path) -> dict[str, list[dict[str, float]]]:
    """Return each phase's training losses by epoch, from ultralytics' tables."""
    import csv

    curves = {}
    for table in sorted(run.glob("*/results.csv")):
        with table.open() as file:
            rows = list(csv.DictReader(file, skipinitialspace=True))
        curves[table.parent.name] = [
            {key.removeprefix("train/"): float(value) for key, value in row.items() if key.startswith("train/")}
            for row in rows
        ]
    return curves


def _versions() -> dict[str, str]:
    from importlib.metadata import version

    return {name: version(name) for name in ("torch", "ultralytics-opencv-headless", "mujoco")}


if __name__ == "__main__":
    main(tyro.cli(Config))
