"""Measure the extrinsics check by the visible jaws: frames of the twin with a camera mount off its drawing.

    .venv/bin/python -m scripts.measure.measure_extrinsics_check                          # 3 mm and 1°; half a minute
    .venv/bin/python -m scripts.measure.measure_extrinsics_check --error-m 0 --error-deg 0    # no correction expected

Each frame shows a bottle, box or cylinder of the benchmark, with its own noise and extrinsics.
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
from hal.base.transforms import inverse, transform_points
from sim_twin.benchmark.episodes.execution import capture
from sim_twin.benchmark.episodes.scenarios import PAPER_OBJECTS, grid
from z1_runtime.perception.extrinsics import ExtrinsicsCheck
from z1_runtime.perception.self_filter import SelfFilter


@dataclass(frozen=True, kw_only=True)
class Config:
    """Error of the extrinsics, and the number of frames."""

    error_m: float = 0.003
    """Translation error in a random direction [m]."""
    error_deg: float = 1.0
    """Rotation error about a random axis [°]."""
    frames: int = 21
    """Frames, spread over the 81 scenarios; each has other extrinsics."""


def main(config: Config) -> None:
    """Print the position error of a point 0.4 m ahead, before and after the correction."""
    check = ExtrinsicsCheck()
    poses = list(grid(PAPER_OBJECTS))
    before, after, corrected, times = [], [], 0, []
    for number in track(range(config.frames), description="frames"):
        error = {"mount_error_m": config.error_m, "mount_error_deg": config.error_deg, "mount_seed": number}
        scene = replace(poses[number * len(poses) // config.frames].scene(), seed=number, **error)
        frame, q = capture(scene)
        watch = Stopwatch()
        jaw = float(q[-1])
        correction = check.correct(frame, SelfFilter().gripper_pixels(frame, jaw), jaw, z1.T_FLANGE_CAMERA)
        times.append(watch.lap_ms())
        corrected += correction is not None
        T_flange_camera = z1.T_FLANGE_CAMERA if correction is None else correction.T_flange_camera
        before.append(measure_offset_mm(z1.T_FLANGE_CAMERA, scene.T_flange_camera()))
        after.append(measure_offset_mm(T_flange_camera, scene.T_flange_camera()))
    table = Table("position error 0.4 m ahead with", "mean", "maximum")
    for name, values in (("the configured extrinsics", before), ("the corrected extrinsics", after)):
        table.add_row(name, f"{np.mean(values):.1f} mm", f"{np.max(values):.1f} mm")
    console = Console()
    console.print(table)
    console.print(f"corrected in {corrected} of {config.frames} frames; {np.median(times[1:]):.0f} ms each (median)")


def measure_offset_mm(T_flange_camera: np.ndarray, T_true: np.ndarray) -> float:
    """Return the position error [mm] of a point 0.4 m ahead of the camera with extrinsics (4, 4)."""
    T = inverse(T_true) @ T_flange_camera
    ahead = np.array([[0.0, 0.0, 0.4]])  # the distance at which the check's own threshold is defined
    return 1e3 * float(np.linalg.norm(transform_points(T, ahead) - ahead))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
