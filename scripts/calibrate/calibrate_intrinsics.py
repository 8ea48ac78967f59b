"""Estimate camera matrix and distortion from images of the board: capture, solve, report.

./z1 calibrate intrinsics
./z1 calibrate intrinsics --samples DIR
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.table import Table

from scripts.calibrate import capture_charuco
from scripts.calibrate.calibration_samples import now, read_samples, show_warnings

if TYPE_CHECKING:
    from calibration.camera_model import CameraModel
    from calibration.intrinsics import IntrinsicsResult


@dataclass(frozen=True, kw_only=True)
class Config:
    """Samples to solve, and folder of the result."""

    samples: Path | None = None
    """Folder of samples to solve; by default they are captured first."""
    calibrations: Path | None = None
    """Folder of results; by default $Z1_CALIBRATIONS, else z1-grasp/calibrations of the user's data."""
    capture: Annotated[capture_charuco.Config, tyro.conf.arg(name="")] = field(default_factory=capture_charuco.Config)
    """Options of the capture."""


def main(config: Config) -> int:
    """Solve and save; return 0 with a result."""
    from calibration.intrinsics import calibrate_intrinsics
    from calibration.report import write_report
    from calibration.results import CalibrationResult, save_result
    from z1_runtime.perception.extrinsics import results_folder

    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    console = Console(highlight=False)
    folder = config.samples or capture_charuco.capture_next_to_results(config.calibrations, config.capture, console)
    detected = read_samples(folder, console)
    info = detected.info
    result = calibrate_intrinsics(detected.views, info.board, names=detected.names)
    show_result(result, info.camera, console)
    show_warnings(result.warnings, console)
    for name, reason in result.rejected.items():
        console.print(f"[yellow]view {name} was rejected:[/] {reason}", soft_wrap=True)
    calibration = CalibrationResult.of_intrinsics(
        result, serial=info.serial, date=now(), board=info.board, folder=str(folder)
    )
    path = save_result(results_folder(config.calibrations), calibration)
    write_report(path.with_suffix(".html"), calibration, result, views=detected.views)
    console.print(f"saved {path}; report {path.with_suffix('.html')}", soft_wrap=True)
    return 0


def show_result(result: IntrinsicsResult, stated: CameraModel, console: Console) -> None:
    """Print the estimated intrinsics next to the device's own."""
    table = Table("", "estimated", "±1 σ", "device", title="intrinsics")
    entries = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    for number, (name, entry) in enumerate(entries.items()):
        estimated, own = result.camera.matrix[entry], stated.matrix[entry]
        table.add_row(f"{name} [px]", f"{estimated:.3f}", f"{result.sd[number]:.3f}", f"{own:.3f}")
    for number, name in enumerate(("k1", "k2", "p1", "p2", "k3")):
        estimated, own = result.camera.distortion[number], stated.distortion[number]
        # The first four deviations are the camera matrix's.
        table.add_row(name, f"{estimated:.5f}", f"{result.sd[4 + number]:.5f}", f"{own:.5f}")
    console.print(table)
    kept = len(result.view_names) - len(result.rejected)
    console.print(
        f"reprojection {result.rms_px:.3f} px, held out {result.holdout_px:.3f} px, from {kept} of "
        f"{len(result.view_names)} views; corners in {(result.coverage > 0).mean():.0%} of the image",
        soft_wrap=True,
    )


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Config)))
