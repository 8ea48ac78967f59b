"""Find camera matrix and distortion from pictures of the board: capture, solve, report.

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
    """Which samples, and where the result goes."""

    samples: Path | None = None
    """Folder of samples to solve; without it they are taken first."""
    calibrations: Path | None = None
    """Folder of results; by default $Z1_CALIBRATIONS, else z1-grasp/calibrations of the user's data."""
    capture: Annotated[capture_charuco.Config, tyro.conf.arg(name="")] = field(default_factory=capture_charuco.Config)
    """How samples are taken."""


def main(config: Config) -> int:
    """Solve and save; 0 when there is a result."""
    from calibration.intrinsics import calibrate_intrinsics
    from calibration.report import write_report
    from calibration.results import Calibration, save_result
    from z1_runtime.perception.extrinsics import results_folder

    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    console = Console(highlight=False)
    folder = config.samples or capture_charuco.capture_beside(config.calibrations, config.capture, console)
    seen = read_samples(folder, console)
    session = seen.session
    result = calibrate_intrinsics(seen.views, session.board, names=seen.names)
    show_result(result, session.camera, console)
    show_warnings(result.warnings, console)
    for name, reason in result.refused.items():
        console.print(f"[yellow]view {name} was refused:[/] {reason}", soft_wrap=True)
    calibration = Calibration.of_intrinsics(
        result, serial=session.serial, date=now(), board=session.board, folder=str(folder)
    )
    path = save_result(results_folder(config.calibrations), calibration)
    write_report(path.with_suffix(".html"), calibration, result, views=seen.views)
    console.print(f"saved {path}; report {path.with_suffix('.html')}", soft_wrap=True)
    return 0


def show_result(result: IntrinsicsResult, stated: CameraModel, console: Console) -> None:
    """Print what was found beside what the camera says of itself."""
    table = Table("", "found", "±1 σ", "the camera says", title="intrinsics")
    places = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    for number, (name, place) in enumerate(places.items()):
        found, says = result.camera.matrix[place], stated.matrix[place]
        table.add_row(f"{name} [px]", f"{found:.3f}", f"{result.sd[number]:.3f}", f"{says:.3f}")
    for number, name in enumerate(("k1", "k2", "p1", "p2", "k3")):
        found, says = result.camera.distortion[number], stated.distortion[number]
        table.add_row(name, f"{found:.5f}", f"{result.sd[4 + number]:.5f}", f"{says:.5f}")
    console.print(table)
    kept = len(result.view_names) - len(result.refused)
    console.print(
        f"reprojection {result.rms_px:.3f} px, held out {result.holdout_px:.3f} px, from {kept} of "
        f"{len(result.view_names)} views; corners in {(result.coverage > 0).mean():.0%} of the picture",
        soft_wrap=True,
    )


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Config)))
