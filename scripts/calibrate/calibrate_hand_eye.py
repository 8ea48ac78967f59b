"""Estimate the camera's pose on the flange with its uncertainty: capture, solve, report.

./z1 calibrate hand-eye                                the twin, with the error against its ground truth
./z1 calibrate hand-eye --hal real                     the arm of a running HAL; place the board 0.4 m in front of it
./z1 calibrate hand-eye --samples DIR                  solve the samples of a folder again
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
from scripts.calibrate.calibration_samples import DetectedSamples, now, read_samples, show_warnings

if TYPE_CHECKING:
    from calibration.camera_model import CameraModel
    from calibration.hand_eye.solver import HandEyeResult


@dataclass(frozen=True, kw_only=True)
class Config:
    """Samples to solve, and folder of the result."""

    samples: Path | None = None
    """Folder of samples to solve; by default they are captured first."""
    intrinsics: Path | None = None
    """Intrinsics result to use instead of the device's own intrinsics."""
    calibrations: Path | None = None
    """Folder of results; by default $Z1_CALIBRATIONS, else z1-grasp/calibrations of the user's data."""
    capture: Annotated[capture_charuco.Config, tyro.conf.arg(name="")] = field(default_factory=capture_charuco.Config)
    """Options of the capture."""


def main(config: Config) -> int:
    """Solve and save; return 0 with a result."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    console = Console(highlight=False)
    folder = config.samples or capture_charuco.capture_next_to_results(config.calibrations, config.capture, console)
    detected = read_samples(folder, console)
    camera = _camera(config, detected)
    result = solve(detected, camera)
    show_result(result, console)
    show_warnings(result.warnings, console)
    ground_truth = _ground_truth(detected)
    if ground_truth is not None:
        _show_error(result, ground_truth, console)
    path = _save(config, detected, camera, result, folder)
    console.print(f"saved {path}; report {path.with_suffix('.html')}, Rerun {path.with_suffix('.rrd')}", soft_wrap=True)
    return 0


def solve(detected: DetectedSamples, camera: CameraModel) -> HandEyeResult:
    """Return the hand-eye result of `detected`, refined by the reprojection error.

    Raises:
        CalibrationError: as `solve_hand_eye`.
    """
    from calibration.board.pose import estimate_board_pose
    from calibration.hand_eye.solver import Refinement, solve_hand_eye

    board = detected.info.board
    poses = [estimate_board_pose(view, board, camera).T_camera_board for view in detected.views]
    return solve_hand_eye(
        # Without samples the shape is (0, 4, 4), for the solver to reject.
        np.array([sample.T_base_flange for sample in detected.samples]).reshape(-1, 4, 4),
        np.array(poses).reshape(-1, 4, 4),
        setup=detected.info.setup,
        refine=Refinement(board=board, camera=camera, views=detected.views),
        names=detected.names,
    )


def show_result(result: HandEyeResult, console: Console) -> None:
    """Print the table of methods, and the uncertainty of the refined result."""
    table = Table("method", "x, y, z [mm]", "spread [mm]", "spread [°]", title="camera pose on the flange")
    rows = [(m.name, m.T_mount_camera, m.rms_mm, m.rms_deg) for m in result.methods]
    for name, T, rms_mm, rms_deg in (*rows, ("refined", result.T_mount_camera, result.rms_mm, result.rms_deg)):
        style = "bold" if name == "refined" else ""
        position = ", ".join(f"{1e3 * value:.2f}" for value in T[:3, 3])
        table.add_row(name, position, f"{rms_mm:.3f}", f"{rms_deg:.4f}", style=style)
    console.print(table)
    kept = len(result.sample_names) - len(result.dropped)
    reprojection = "" if result.rms_px is None else f", reprojection {result.rms_px:.3f} px"
    console.print(
        f"[bold]±{result.uncertainty_mm:.3f} mm, ±{result.uncertainty_deg:.4f}°[/] from {kept} of "
        f"{len(result.sample_names)} samples; held out {result.holdout_mm:.3f} mm, {result.holdout_deg:.4f}°"
        f"{reprojection}; diversity of the poses {result.diversity:.2f}",
        soft_wrap=True,
    )


def _camera(config: Config, detected: DetectedSamples) -> CameraModel:
    if config.intrinsics is None:
        return detected.info.camera
    from calibration.results import load_result

    found = load_result(config.intrinsics, serial=detected.info.serial)
    if found.kind != "intrinsics":
        raise InvalidValueError(
            f"--intrinsics: {config.intrinsics} is a result of kind {found.kind}, allowed is intrinsics."
        )
    return found.camera


def _ground_truth(detected: DetectedSamples) -> np.ndarray | None:
    """Return the twin's T_mount_camera (4, 4); None for a real arm."""
    ground_truth = detected.info.ground_truth
    return None if ground_truth is None else np.array(ground_truth["T_mount_camera"])


def _show_error(result: HandEyeResult, ground_truth: np.ndarray, console: Console) -> None:
    from hal.base.transforms import pose_error

    error_m, error_rad = pose_error(ground_truth, result.T_mount_camera)
    error_mm, error_deg = 1e3 * error_m, float(np.rad2deg(error_rad))
    # Both, as `scripts.measure.measure_calibration` counts.
    inside = error_mm <= result.uncertainty_mm and error_deg <= result.uncertainty_deg
    console.print(
        f"against the twin's ground truth: [bold]{error_mm:.3f} mm, {error_deg:.4f}°[/], "
        f"{'within' if inside else '[red]outside[/]'} the stated uncertainty",
        soft_wrap=True,
    )


def _save(config: Config, detected: DetectedSamples, camera: CameraModel, result: HandEyeResult, folder: Path) -> Path:
    """Save result, report and recording into one folder; return the path of the result."""
    from calibration.report import write_report
    from calibration.results import CalibrationResult, save_result
    from z1_runtime.perception.extrinsics import results_folder
    from z1_runtime.visualization.calibration_recording import SolvedSamples, write_recording

    info = detected.info
    calibration = CalibrationResult.of_hand_eye(
        result, serial=info.serial, date=now(), board=info.board, camera=camera, folder=str(folder)
    )
    path = save_result(results_folder(config.calibrations), calibration)
    write_report(
        path.with_suffix(".html"),
        calibration,
        result,
        views=detected.views,
        Ts_base_flange=np.array([sample.T_base_flange for sample in detected.samples]),
        ground_truth=_ground_truth(detected),
    )
    if info.setup == "eye_in_hand":
        write_recording(
            path.with_suffix(".rrd"),
            SolvedSamples(
                board=info.board,
                camera=camera,
                names=detected.names,
                samples=detected.samples,
                views=detected.views,
                result=result,
            ),
        )
    return path


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Config)))
