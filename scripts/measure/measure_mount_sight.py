"""Measures how well the jaws in the picture tell where the camera sits: looks of the twin with a mount off its drawing.

    .venv/bin/python -m scripts.measure.measure_mount_sight                              # 3 mm and 1°; half a minute
    .venv/bin/python -m scripts.measure.measure_mount_sight --error-m 0 --error-deg 0    # a right one is left alone

Each look has a bottle, box or cylinder of the benchmark before it, and noise and a mount of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from hal.base import z1
from hal.base.clock import Stopwatch
from hal.base.transforms import inverse
from sim_twin.benchmark.episodes.execution import capture
from sim_twin.benchmark.episodes.scenarios import PAPER_OBJECTS, grid
from z1_runtime.perception.extrinsics_check import ExtrinsicsCheck


@dataclass(frozen=True, kw_only=True)
class Config:
    """How far the mount is off, and how often it is looked at."""

    error_m: float = 0.003
    """In a random direction [m]."""
    error_deg: float = 1.0
    """About a random axis [°]."""
    looks: int = 21
    """Looks, spread over the 81 scenarios; each has another mount."""


def main(config: Config) -> None:
    """Look, and say how far beside its place what is 0.4 m ahead is shown."""
    sight = ExtrinsicsCheck()
    poses = list(grid(PAPER_OBJECTS))
    before, after, corrected, times = [], [], 0, []
    for number in track(range(config.looks), description="looks"):
        off = {"mount_error_m": config.error_m, "mount_error_deg": config.error_deg, "mount_seed": number}
        scene = replace(poses[number * len(poses) // config.looks].scene(), seed=number, **off)
        frame, q = capture(scene)
        watch = Stopwatch()
        seen = sight.correct(frame, float(q[-1]), z1.T_FLANGE_CAMERA)
        times.append(watch.lap_ms())
        corrected += seen is not None
        believed = z1.T_FLANGE_CAMERA if seen is None else seen.T_flange_camera
        before.append(beside_mm(z1.T_FLANGE_CAMERA, scene.T_flange_camera()))
        after.append(beside_mm(believed, scene.T_flange_camera()))
    table = Table("what is 0.4 m ahead is shown beside its place by", "mean", "worst")
    for name, values in (("the mount as it is known", before), ("the mount that the jaws show", after)):
        table.add_row(name, f"{np.mean(values):.1f} mm", f"{np.max(values):.1f} mm")
    console = Console()
    console.print(table)
    console.print(f"corrected in {corrected} of {config.looks} looks; {np.median(times[1:]):.0f} ms each (median)")


def beside_mm(T_flange_camera: np.ndarray, T_true: np.ndarray) -> float:
    """Return how far beside its place a mount (4, 4) shows what is 0.4 m ahead [mm]."""
    T = inverse(T_true) @ T_flange_camera
    ahead = np.array([0.0, 0.0, 0.4])
    return 1e3 * float(np.linalg.norm(T[:3, :3] @ ahead + T[:3, 3] - ahead))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
