"""Measure the gripper's collision check against a full-resolution scene, as the paper's table does.

python -m scripts.measure.measure_collision --n-candidates 800 --n-points 200000
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hal.base.clock import Stopwatch
from z1_runtime.collision.voxel_grid import SceneIndex
from z1_runtime.geometry.gripper_geometry import gripper_shape


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """Extent of the measurement."""

    n_candidates: int = 800
    """Gripper poses."""
    n_points: int = 200_000
    """Points of the scene."""
    threshold_m: float = 0.002
    """Distance that counts as a hit (the paper's) [m]."""
    repeats: int = 15
    """Number of runs; their median is shown."""
    seed: int = 0
    """Seed of scene and poses."""


def make_scene(n_points: int, rng: np.random.Generator) -> np.ndarray:
    """Return the points (n_points, 3) of a table with three boxes on it [m]."""
    table = np.column_stack([rng.uniform(0.2, 0.9, n_points // 2), rng.uniform(-0.4, 0.4, n_points // 2)])
    parts = [np.column_stack([table, rng.normal(0.0, 0.001, len(table))])]
    for y in (-0.15, 0.0, 0.15):
        box = rng.uniform(-1.0, 1.0, ((n_points - len(table)) // 3, 3)) * [0.03, 0.03, 0.075]
        face = rng.integers(0, 3, len(box))
        rows = np.arange(len(box))
        box[rows, face] = np.sign(box[rows, face]) * np.array([0.03, 0.03, 0.075])[face]
        parts.append(box + np.array([0.5, y, 0.075]))
    return np.concatenate(parts)


def make_poses(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return frontal gripper poses (n, 4, 4) around the middle box, from free to deep inside it."""
    T = np.tile(np.eye(4), (n, 1, 1))
    turn = np.column_stack([rng.uniform(-0.4, 0.4, n), rng.uniform(0.0, 0.7, n), rng.uniform(1.2, 1.9, n)])
    T[:, :3, :3] = Rotation.from_euler("zyx", turn).as_matrix()
    T[:, :3, 3] = rng.uniform([0.25, -0.08, 0.08], [0.45, 0.08, 0.25], (n, 3))
    return T


def median_ms(work: Callable[[], object], repeats: int) -> float:
    """Return the median time of `work` [ms], without the first run, which compiles."""
    work()
    times = []
    for _ in range(repeats):
        watch = Stopwatch()
        work()
        times.append(watch.lap_ms())
    return float(np.median(times))


def main(config: Config) -> None:
    """Measure and print the table."""
    rng = np.random.default_rng(config.seed)
    points = make_scene(config.n_points, rng)
    T = make_poses(config.n_candidates, rng)
    shape = gripper_shape()
    vertices = np.concatenate([shape.fixed, shape.moving_jaw])
    index, tree = SceneIndex(points), cKDTree(points)
    free = T.copy()
    free[:, 2, 3] += 0.5  # above all boxes, which are 0.15 m high

    def by_tree() -> np.ndarray:
        moved = np.einsum("nij,vj->nvi", T[:, :3, :3], vertices) + T[:, None, :3, 3]
        # The bound itself is excluded: 1 % more keeps hits at exactly the threshold.
        distance = tree.query(moved.reshape(-1, 3), distance_upper_bound=config.threshold_m * 1.01)[0]
        return distance.reshape(len(T), -1).min(axis=1) <= config.threshold_m

    hits = index.collides(T, vertices, config.threshold_m)
    equal = bool((hits == by_tree()).all())
    title = f"{len(T)} poses × {len(vertices)} vertices against {len(points)} points, {hits.mean():.0%} of them hit"
    table = Table("step", "median ms", title=title)
    table.add_row("build the voxel index", f"{median_ms(lambda: SceneIndex(points), config.repeats):.1f}")
    rows = {"check, as posed": T, "check, only those that are free": T[~hits], "check, far above the scene": free}
    for name, poses in rows.items():
        # A default binds the poses now; the loop changes the variable.
        ms = median_ms(lambda p=poses: index.collides(p, vertices, config.threshold_m), config.repeats)
        table.add_row(f"{name} ({len(poses)})", f"{ms:.1f}")
    table.add_row("the same by KD-tree", f"{median_ms(by_tree, 2):.0f}")
    table.add_row("the same results", "yes" if equal else "[red]no[/red]")
    Console().print(table)
    if not equal:
        raise SystemExit("the voxel index and the KD-tree disagree.")


if __name__ == "__main__":
    main(tyro.cli(Config))
