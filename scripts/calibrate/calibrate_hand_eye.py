"""Find where the camera sits on the flange, and how far to trust that: capture, solve, report.

./z1 calibrate hand-eye                                the twin, with the error against its truth
./z1 calibrate hand-eye --hal real                     the arm whose HAL runs; lay the board 0.4 m in front of it first
./z1 calibrate hand-eye --samples DIR                  solve samples again that are on disk
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from hal.base.errors import InvalidValueError
from scripts.calibrate import capture_charuco
from scripts.calibrate.calibration_samples import SeenSamples, now, read_samples, show_warnings

if TYPE_CHECKING:
    from calibration.camera_model import CameraModel
    from calibration.hand_eye.solver import HandEyeResult


@dataclass(frozen=True, kw_only=True)
class Config:
    """Which samples, and where the result goes."""

    samples: Path | None = None
    """Folder of samples to solve; without it they are taken first."""
    intrinsics: Path | None = None
    """An intrinsics result to use instead of what the camera says of itself."""
    calibrations: Path | None = None
    """Folder of results; by default $Z1_CALIBRATIONS, else z1-grasp/calibrations of the user's data."""
    capture: Annotated[capture_charuco.Config, tyro.conf.arg(name="")] = field(default_factory=capture_charuco.Config)
    """How samples are taken."""


def main(config: Config) -> int:
    """Solve and save; 0 when there is a result."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    console = Console(highlight=False)
    folder = config.samples or capture_charuco.capture_beside(config.calibrations, config.capture, console)
    seen = read_samples(folder, console)
    camera = _camera(config, seen)
    result = solve(seen, camera)
    show_result(result, console)
    show_warnings(result.warnings, console)
    truth = _truth(seen)
    if truth is not None:
        _show_error(result, truth, console)
    path = _save(config, seen, camera, result, folder)
    console.print(f"saved {path}; report {path.with_suffix('.html')}, Rerun {path.with_suffix('.rrd')}", soft_wrap=True)
    return 0


def solve(seen: SeenSamples, camera: CameraModel) -> HandEyeResult:
    """Return the hand-eye result of `seen`, refined by the reprojection error.

    Raises:
        CalibrationError: as `solve_hand_eye`; the message says what to do.
    """
    from calibration.board.pose import estimate_board_pose
    from calibration.hand_eye.solver import Refinement, solve_hand_eye

    board = seen.session.board
    poses = [estimate_board_pose(view, board, camera).T_camera_board for view in seen.views]
    return solve_hand_eye(
        np.array([sample.T_base_flange for sample in seen.samples]).reshape(-1, 4, 4),
        np.array(poses).reshape(-1, 4, 4),
        setup=seen.session.setup,
        refine=Refinement(board=board, camera=camera, views=seen.views),
        names=seen.names,
    )


def show_result(result: HandEyeResult, console: Console) -> None:
    """Print the table of methods, and what the refined result is worth."""
    table = Table("method", "x, y, z [mm]", "spread [mm]", "spread [°]", title="where the camera sits")
    rows = [(m.name, m.T_mount_camera, m.rms_mm, m.rms_deg) for m in result.methods]
    for name, T, rms_mm, rms_deg in (*rows, ("refined", result.T_mount_camera, result.rms_mm, result.rms_deg)):
        style = "bold" if name == "refined" else ""
        place = ", ".join(f"{1e3 * value:.2f}" for value in T[:3, 3])
        table.add_row(name, place, f"{rms_mm:.3f}", f"{rms_deg:.4f}", style=style)
    console.print(table)
    kept = len(result.sample_names) - len(result.dropped)
    reprojection = "" if result.rms_px is None else f", reprojection {result.rms_px:.3f} px"
    console.print(
        f"[bold]±{result.uncertainty_mm:.3f} mm, ±{result.uncertainty_deg:.4f}°[/] from {kept} of "
        f"{len(result.sample_names)} samples; held out {result.holdout_mm:.3f} mm, {result.holdout_deg:.4f}°"
        f"{reprojection}; diversity of the poses {result.diversity:.2f}",
        soft_wrap=True,
    )


def _camera(config: Config, seen: SeenSamples) -> CameraModel:
    if config.intrinsics is None:
        return seen.session.camera
    from calibration.results import load_result

    found = load_result(config.intrinsics, serial=seen.session.serial)
    if found.kind != "intrinsics":
        raise InvalidValueError(
            f"{config.intrinsics} is a result of kind {found.kind}; --intrinsics takes one of intrinsics."
        )
    return found.camera


def _truth(seen: SeenSamples) -> np.ndarray | None:
    """Return T_mount_camera (4, 4) as the twin knows it."""
    return None if seen.session.truth is None else np.array(seen.session.truth["T_mount_camera"])


def _show_error(result: HandEyeResult, truth: np.ndarray, console: Console) -> None:
    from hal.base.transforms import pose_error

    error_m, error_rad = pose_error(truth, result.T_mount_camera)
    error_mm, error_deg = 1e3 * error_m, float(np.rad2deg(error_rad))
    inside = error_mm <= result.uncertainty_mm and error_deg <= result.uncertainty_deg
    console.print(
        f"against the twin's truth: [bold]{error_mm:.3f} mm, {error_deg:.4f}°[/], "
        f"{'within' if inside else '[red]outside[/]'} the uncertainty told",
        soft_wrap=True,
    )


def _save(config: Config, seen: SeenSamples, camera: CameraModel, result: HandEyeResult, folder: Path) -> Path:
    """Save result, report and recording beside each other; return the path of the result."""
    from calibration.report import write_report
    from calibration.results import Calibration, save_result
    from z1_runtime.perception.extrinsics import results_folder
    from z1_runtime.visualization.calibration_recording import SolvedSamples, write_recording

    session = seen.session
    calibration = Calibration.of_hand_eye(
        result, serial=session.serial, date=now(), board=session.board, camera=camera, folder=str(folder)
    )
    path = save_result(results_folder(config.calibrations), calibration)
    write_report(
        path.with_suffix(".html"),
        calibration,
        result,
        views=seen.views,
        Ts_base_flange=np.array([sample.T_base_flange for sample in seen.samples]),
        T_mount_camera_truth=_truth(seen),
    )
    if session.setup == "eye_in_hand":
        write_recording(
            path.with_suffix(".rrd"),
            SolvedSamples(
                board=session.board,
                camera=camera,
                names=seen.names,
                samples=seen.samples,
                views=seen.views,
                result=result,
            ),
        )
    return path


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Config)))
