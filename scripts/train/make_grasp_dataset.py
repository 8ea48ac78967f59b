"""Make the grasp generator's training data: procedural shapes, noisy single views, verified antipodal grasps.

    python -m scripts.train.make_grasp_dataset                  # 64 shards of 100 shapes × 4 views
    python -m scripts.train.make_grasp_dataset --shards 2       # a small one
    python -m scripts.train.make_grasp_dataset --gripper z1     # for the Z1's own gripper
    python -m scripts.train.make_grasp_dataset --seed 2000 --view.occluded-view-ratio 1    # more, all occluded in part

Existing shards are kept, so an interrupted run resumes. Each is made from its own seed. Every label passes the exact
check; one of each shape is also simulated in MuJoCo, with the outcome in `<shard>.simulated.json`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from rich.progress import track

from models.diffusion.training.grippers import GRIPPERS, ParallelGripperSpec
from models.diffusion.training.shards import make_shard, save_shard, simulate_shard
from models.diffusion.training.views import ViewConfig


@dataclass(frozen=True, kw_only=True)
class Config:
    """Amount of data, and its gripper."""

    gripper: str = "agnostic"
    """Gripper of `models.diffusion.training.grippers.GRIPPERS`."""
    shards: int = 64
    """Files to make."""
    shapes: int = 100
    """Shapes in a file."""
    views: int = 4
    """Views of each shape."""
    simulations: int = 1
    """Labels of each shape that are simulated; none for the Z1 gripper, whose jaws the dynamics test does not model."""
    seed: int = 1000
    """Seed of the first shard; shard k takes seed + k."""
    view: ViewConfig = field(default_factory=ViewConfig)
    """Poses of the shapes, viewpoints and depth errors."""
    out: Path = Path("out/diffusion")
    """Folder for the shards."""


def main(config: Config) -> None:
    """Make the shards that are missing."""
    folder, gripper = config.out / config.gripper, GRIPPERS[config.gripper]
    folder.mkdir(parents=True, exist_ok=True)
    for shard in track(range(config.shards), description="shards"):
        path = folder / f"{config.seed + shard}.npz"
        if not path.exists():
            save_shard(path, make_shard(gripper, config.seed + shard, config.shapes, config.views, config.view))
        outcome = path.with_suffix(".simulated.json")
        if config.simulations and isinstance(gripper, ParallelGripperSpec) and not outcome.exists():
            with np.load(path, allow_pickle=False) as arrays:
                outcome.write_text(json.dumps(simulate_shard(dict(arrays), gripper, config.simulations)) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Config))
