"""Makes the grasp generator's training data: procedural shapes, noisy single views, verified antipodal grasps.

    python -m scripts.train.make_grasp_dataset                  # 64 shards of 100 shapes × 4 views
    python -m scripts.train.make_grasp_dataset --shards 2       # a small one
    python -m scripts.train.make_grasp_dataset --gripper z1     # for the Z1's own beak
    python -m scripts.train.make_grasp_dataset --seed 2000 --view.occluded-share 1    # more, all with a part hidden

Shards that exist are kept, so an interrupted run goes on where it stopped. Each is made from its own seed.
Every label passes the exact check; one of each shape is also shaken in MuJoCo: `<shard>.simulated.json` has the outcome.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from rich.progress import track

from models.diffusion.cloud import prepare_cloud
from models.diffusion.training.dynamics_test import simulate_grasps
from models.diffusion.training.labels import GRIPPERS, ParallelGripperSpec, AnyGripper, check_grasps, find_grasps
from models.diffusion.training.shapes import FAMILY_WEIGHTS, make_shape
from models.diffusion.training.solids import Solid
from models.diffusion.training.views import ViewConfig, render_view

_MIN_GRASPS = 40
_MAX_GRASPS = 384
_MAX_PARTS = 3


@dataclass(frozen=True, kw_only=True)
class Config:
    """How much data, and for which hand."""

    gripper: str = "agnostic"
    """Which hand of `models.diffusion.training.labels.GRIPPERS`."""
    shards: int = 64
    """Files to make."""
    shapes: int = 100
    """Shapes in a file."""
    views: int = 4
    """Views of each shape."""
    simulated: int = 1
    """Labels of each shape that are tried in dynamics; none for the beak, whose jaws are not modelled there."""
    seed: int = 1000
    """Seed of the first shard; shard k takes seed + k."""
    view: ViewConfig = field(default_factory=ViewConfig)
    """How the shapes lie and are seen."""
    out: Path = Path("out/graspgen")
    """Folder for the shards."""


def main(config: Config) -> None:
    """Make the shards that are missing."""
    folder, gripper = config.out / config.gripper, GRIPPERS[config.gripper]
    folder.mkdir(parents=True, exist_ok=True)
    for shard in track(range(config.shards), description="shards"):
        path = folder / f"{config.seed + shard}.npz"
        if not path.exists():
            save_shard(path, make_shard(gripper, config.seed + shard, config.shapes, config.views, config.view))
        verdicts = path.with_suffix(".shaken.json")
        if config.simulated and isinstance(gripper, ParallelGripperSpec) and not verdicts.exists():
            with np.load(path, allow_pickle=False) as arrays:
                verdicts.write_text(json.dumps(simulate_shard(dict(arrays), gripper, config.simulated)) + "\n")


def save_shard(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a shard so that it is whole or not there."""
    partial = path.with_suffix(".partial.npz")
    np.savez(partial, allow_pickle=False, **arrays)
    partial.rename(path)


def simulate_shard(arrays: dict[str, np.ndarray], gripper: ParallelGripperSpec, count: int) -> dict:
    """Return how many of `count` labels of each shape were tried in dynamics, and which were lost, by family."""
    tried: Counter[str] = Counter()
    lost: Counter[str] = Counter()
    for family, parts, profiles, T, n in zip(
        *(arrays[key] for key in ("family", "parts", "profiles", "grasps", "n_grasps")), strict=True
    ):
        solid = Solid(family=str(family), parts=parts, profiles=profiles)
        labels = T[: min(count, n)].astype(np.float64)  # a shard's labels are in random order
        held = simulate_grasps(solid, labels, check_grasps(solid, labels, gripper), gripper)
        tried[solid.family] += len(held)
        lost[solid.family] += int((~held).sum())
    return {"tried": dict(tried), "lost": dict(+lost)}


def make_shard(
    gripper: AnyGripper, seed: int, n_shapes: int, n_views: int, view: ViewConfig | None = None
) -> dict[str, np.ndarray]:
    """Return one shard's arrays; S shapes, V = S × views.

    `clouds` (V, 512, 6) points and normals in the view frame, `T_view_object` (V, 4, 4), `shape` (V,) index of the
    shape, `family` (S,), `parts` and `profiles` (S, 3, …) the solids, `grasps` (S, 384, 4, 4) in the object frame with
    their widths (S, 384) [m], `n_grasps` (S,).
    """
    rng = np.random.default_rng(seed)
    families = list(FAMILY_WEIGHTS)
    rows: dict[str, list] = {k: [] for k in ("clouds", "T_view_object", "shape", "family", "parts", "profiles")}
    rows |= {k: [] for k in ("grasps", "widths_m", "n_grasps")}
    while len(rows["family"]) < n_shapes:
        solid = make_shape(str(rng.choice(families, p=list(FAMILY_WEIGHTS.values()))), rng)
        T, widths = find_grasps(solid, gripper, rng)
        if len(T) < _MIN_GRASPS:
            continue
        views = draw_views(solid, view or ViewConfig(), n_views, rng)
        for cloud, T_view_object in views:
            rows["clouds"].append(cloud)
            rows["T_view_object"].append(T_view_object)
            rows["shape"].append(len(rows["family"]))
        keep = rng.permutation(len(T))
        rows["n_grasps"].append(min(len(T), _MAX_GRASPS))
        keep = np.resize(keep, _MAX_GRASPS)
        rows["grasps"].append(T[keep].astype(np.float32))
        rows["widths_m"].append(widths[keep].astype(np.float32))
        rows["family"].append(solid.family)
        rows["parts"].append(_padded(solid.parts))
        rows["profiles"].append(_padded(solid.profiles))
    return {key: np.array(values) for key, values in rows.items()}


def draw_views(
    solid: Solid, config: ViewConfig, count: int, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return `count` views of `solid`: cloud (512, 6) float16 in the view frame, and T_view_object (4, 4)."""
    views: list[tuple[np.ndarray, np.ndarray]] = []
    while len(views) < count:
        seen = render_view(solid, config, rng)
        if seen is None:
            continue
        points, T_camera_object = seen
        cloud = prepare_cloud(points, rng)
        rows = np.concatenate([cloud.points, cloud.normals], axis=1).astype(np.float16)
        views.append((rows, (np.linalg.inv(cloud.T_camera_view) @ T_camera_object).astype(np.float32)))
    return views


def _padded(rows: np.ndarray) -> np.ndarray:
    """Return `rows` filled up to the greatest number of parts; a part given twice leaves the union as it is."""
    return np.concatenate([rows, np.repeat(rows[-1:], _MAX_PARTS - len(rows), axis=0)])


if __name__ == "__main__":
    main(tyro.cli(Config))
