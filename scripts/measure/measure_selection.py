"""Latency of the selection on one core: `OMP_NUM_THREADS=1 python -m scripts.measure.measure_selection [repeats]`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

from hal.base.clock import Stopwatch
from models.obb.mvbb import fit_obb, rank_grasps
from models.samplers.antipodal import AntipodalSampler
from models.types import GraspSet

N_POINTS = 5000
N_GRASPS = 800
UP = np.array([0.0, -1.0, 0.0])  # in the camera frame, whose y points down


def make_box_view(rng: np.random.Generator) -> np.ndarray:
    """Return (5000, 3) points [m] on three visible faces of a 60 × 100 × 180 mm box, at 0.4 m, with 0.7 mm noise."""
    half = np.array([0.03, 0.09, 0.05])
    points = rng.uniform(-half, half, (N_POINTS, 3))
    face = rng.integers(0, 3, N_POINTS)
    points[np.arange(N_POINTS), face] = -half[face]
    yaw = np.deg2rad(35.0)
    R = np.array([[np.cos(yaw), 0.0, np.sin(yaw)], [0.0, 1.0, 0.0], [-np.sin(yaw), 0.0, np.cos(yaw)]])
    return points @ R.T + np.array([0.0, 0.05, 0.4]) + rng.normal(0.0, 0.7e-3, (N_POINTS, 3))


def make_random_grasps(rng: np.random.Generator) -> GraspSet:
    """Return 800 grasps with rotations uniform over all directions, near the box."""
    T = np.tile(np.eye(4), (N_GRASPS, 1, 1))
    q, _ = np.linalg.qr(rng.normal(size=(N_GRASPS, 3, 3)))
    T[:, :3, :3] = q * np.linalg.det(q)[:, None, None]  # −1 times a reflection is a rotation
    T[:, :3, 3] = [0.0, 0.05, 0.4]
    return GraspSet(T_camera_grasps=T, scores=rng.uniform(size=N_GRASPS), widths_m=np.full(N_GRASPS, 0.06))


def measure_ms(run: Callable[[], object], repeats: int) -> np.ndarray:
    """Return the times (repeats,) of `run` [ms], after two warm-up calls."""
    times = []
    for index in range(repeats + 2):
        watch = Stopwatch()
        run()
        if index >= 2:
            times.append(watch.lap_ms())
    return np.array(times)


def main() -> None:
    """Print median and 95th percentile of each case, and its budget."""
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    rng = np.random.default_rng(0)
    points, grasps = make_box_view(rng), make_random_grasps(rng)
    sampler = AntipodalSampler()
    cases: list[tuple[str, Callable[[], object], float | None, int]] = [
        ("pca: fit, filter, re-score", lambda: rank_grasps(grasps, fit_obb(points, "pca")), 0.7, repeats),
        ("upright: fit, filter, re-score", lambda: rank_grasps(grasps, fit_obb(points, up=UP)), 4.0, repeats),
        ("min_volume: fit, filter, re-score", lambda: rank_grasps(grasps, fit_obb(points, "min_volume")), None, 20),
        ("antipodal: 800 candidates", partial(sampler.sample, points, N_GRASPS, 0), 100.0, 20),
    ]
    table = Table("case", "median ms", "p95 ms", "budget ms", title=f"{N_GRASPS} candidates, {N_POINTS} points")
    for name, run, budget_ms, count in cases:
        times = measure_ms(run, count)
        budget = "–" if budget_ms is None else f"{budget_ms:g}"
        table.add_row(name, f"{np.median(times):.2f}", f"{np.percentile(times, 95):.2f}", budget)
    Console().print(table)


if __name__ == "__main__":
    main()
