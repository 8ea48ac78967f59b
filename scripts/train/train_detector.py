"""Train the detector on the CPU, from scratch, and write its weights.

    python -m scripts.train.make_detection_dataset
    python -m scripts.train.train_detector --processes 2   # resumes
    python -m scripts.train.evaluate_detector              # writes models/weights/detector.json and a picture

Checkpoints and logs are in out/detector/run. Phases at growing picture sizes, see `models.detector.training`.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Thread

import tyro

from hal.base.errors import MissingFileError
from models.detector.weights import WEIGHTS_FOLDER
from sim_twin.detection_data.props import CLASSES


@dataclass(frozen=True, kw_only=True)
class Config:
    """Data, folders and resources of the training."""

    data: Path = Path("out/detector/data")
    """Folder of `make_detection_dataset`."""
    run: Path = Path("out/detector/run")
    """Folder for checkpoints; another one starts a new run."""
    threads: int = 1
    """Processor threads of each process."""
    processes: int = 1
    """Processes that share each batch; two processes on two cores are faster than two threads."""
    seed: int = 0
    """Of weights, order and augmentation."""
    weights: Path = WEIGHTS_FOLDER / "detector.npz"
    """File of the weights."""


def main(config: Config) -> None:
    """Train the phases that are not complete, and write the weights."""
    manifest = config.data / "data.yaml"
    if not manifest.is_file():
        raise MissingFileError(
            f"{manifest} is missing; make it with `python -m scripts.train.make_detection_dataset`.", code="no_data"
        )
    if config.processes > 1:
        _train_together(config)
    # After `_train_together` all phases are complete: it only finds them.
    write_weights(config, train(config, manifest))


def train(config: Config, manifest: Path) -> Path:
    """Train the remaining phases on the pictures of `manifest`; return the last checkpoint."""
    from models.detector.training import TRAINING_PHASES, train_phase

    checkpoint = None
    for number, phase in enumerate(TRAINING_PHASES):
        folder = (config.run / f"{number}_{phase.imgsz}").resolve()
        checkpoint = train_phase(
            phase, data=manifest, folder=folder, start=checkpoint, seed=config.seed, threads=config.threads
        )
    assert checkpoint is not None
    return checkpoint


def _train_together(config: Config) -> None:
    """Run `train` in several processes; a failure of one ends the others."""
    from torch.multiprocessing.spawn import spawn

    with tempfile.TemporaryDirectory() as folder:
        spawn(_train_as_peer, (config, f"file://{folder}/rendezvous"), nprocs=config.processes)


def _train_as_peer(rank: int, config: Config, rendezvous: str) -> None:
    ranks = {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(config.processes)}
    os.environ |= ranks  # ultralytics reads them at import, and splits the pictures by them
    end_with_parent()
    from torch import distributed

    # gloo is torch's backend for CPUs; a rendezvous by a file needs no free port.
    distributed.init_process_group("gloo", init_method=rendezvous, rank=rank, world_size=config.processes)
    train(config, config.data / "data.yaml")
    distributed.destroy_process_group()


def end_with_parent() -> None:
    """End this process when its parent ends, even if that was killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)  # sys.exit would end this thread alone

    Thread(target=wait, daemon=True).start()


def write_weights(config: Config, checkpoint: Path) -> None:
    """Write the weights of `checkpoint`, their checksum and the recipe."""
    from models.detector.training import ARCHITECTURE, AUGMENTATION, GAINS, TRAINING_PHASES, read_checkpoint
    from models.detector.weights import save_detector

    digest = save_detector(config.weights, read_checkpoint(checkpoint), CLASSES)
    recipe = {
        "architecture": ARCHITECTURE,
        "seed": config.seed,
        "processes": config.processes,
        "phases": [asdict(phase) for phase in TRAINING_PHASES],
    }
    recipe |= {"augmentation": AUGMENTATION, "gains": GAINS}
    recipe |= {"data": json.loads((config.data / "recipe.json").read_text())}
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
