"""Report of a calibration: one self-contained HTML file with its accuracy and its samples."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from calibration import plots
from calibration.board.detection import BoardView
from calibration.hand_eye.result import HandEyeResult
from calibration.hand_eye.uncertainty import COVERAGE
from calibration.intrinsics import IntrinsicsResult
from calibration.pose_checks import pose_distances_mm_deg
from calibration.results import CalibrationResult
from hal.base.files import atomic_write
from hal.base.output_folder import check_output_file
from hal.base.transforms import inverse, rotation_vectors


def write_report(
    path: Path,
    calibration: CalibrationResult,
    result: HandEyeResult | IntrinsicsResult,
    *,
    views: Sequence[BoardView] = (),
    Ts_base_flange: np.ndarray | None = None,
    ground_truth: np.ndarray | None = None,
) -> None:
    """Write the report of `result`.

    Args:
        path: of the HTML file; it is replaced.
        calibration: the result as saved, with its origin.
        result: the solver's result.
        views: one a sample, for the map of detected corners.
        Ts_base_flange: (N, 4, 4) the arm's poses, for the spread of the rotation axes (hand-eye).
        ground_truth: (4, 4) true T_mount_camera, where it is known.
    """
    if isinstance(result, HandEyeResult):
        content = _hand_eye_content(result, Ts_base_flange, ground_truth)
    else:
        content = _intrinsics_content(result)
    if views:
        corners = plots.plot_points(np.vstack([view.pixels_px for view in views]), views[0].image_size)
        content["sections"]["Coverage"] = [(corners, "All detected corners in the image.")]
    environment = Environment(loader=PackageLoader("calibration"), autoescape=True, undefined=StrictUndefined)
    html = environment.get_template("report.html.j2").render(
        origin=_origin(calibration), warnings=calibration.quality_warnings(), **content
    )
    atomic_write(check_output_file(path), html + "\n")


def _origin(calibration: CalibrationResult) -> dict[str, str]:
    board, used, dropped = calibration.board, calibration.samples["used"], calibration.samples["dropped"]
    return {
        "Camera": calibration.serial,
        "Date": calibration.date,
        "File": str(calibration.path or "not saved"),
        "Board": f"{board.columns} × {board.rows}, squares {1e3 * board.square_m:g} mm, {board.dictionary}",
        "Samples": f"{len(used)} used, {len(dropped)} left out, from {calibration.samples['folder']}",
        **{f"left out: {name}": reason for name, reason in dropped.items()},
    }


def _hand_eye_content(
    result: HandEyeResult, Ts_base_flange: np.ndarray | None, ground_truth: np.ndarray | None
) -> dict[str, Any]:
    mount = "flange" if result.setup == "eye_in_hand" else "base"
    sections = _residual_sections(result)
    if Ts_base_flange is not None:
        Ts_mount = Ts_base_flange if result.setup == "eye_in_hand" else inverse(Ts_base_flange)
        turns_deg = np.degrees(rotation_vectors(np.swapaxes(Ts_mount[:1, :3, :3], 1, 2) @ Ts_mount[:, :3, :3]))
        caption = f"Rotation from the first sample, axis times angle in {mount} axes [°]."
        sections["Spread of the rotations"] = [(plots.plot_rotations(turns_deg), caption)]
    return {
        "title": "Hand-eye calibration",
        "figures": _hand_eye_figures(result, ground_truth),
        "matrix": (f"T_{mount}_camera", _format_matrix(result.T_mount_camera)),
        "sections": sections,
        "methods": _method_rows(result, ground_truth),
    }


def _hand_eye_figures(result: HandEyeResult, ground_truth: np.ndarray | None) -> dict[str, str]:
    percent = f"{100 * COVERAGE:g} %"
    figures = {
        f"True position is within ({percent})": f"{result.uncertainty_mm:.2f} mm",
        f"True orientation is within ({percent})": f"{result.uncertainty_deg:.3f}°",
        "Residual (rms)": f"{result.rms_mm:.2f} mm, {result.rms_deg:.3f}°",
        "Hold-out error (rms)": f"{result.holdout_mm:.2f} mm, {result.holdout_deg:.3f}°",
        "Reprojection (rms)": "not refined" if result.rms_px is None else f"{result.rms_px:.2f} px",
        "Scatter of the arm": f"{1e3 * result.noise.arm_m:.2f} mm, {np.degrees(result.noise.arm_rad):.3f}° an axis",
        "Pose diversity": f"{result.diversity:.2f} of 1",
    }
    if result.square_m is not None:
        figures["Squares as the arm measures them"] = f"{1e3 * result.square_m:.2f} mm"
    if ground_truth is not None:
        mm, deg = pose_distances_mm_deg(result.T_mount_camera, ground_truth)
        figures["Error against the ground truth"] = f"{mm:.3f} mm, {deg:.4f}°"
    return figures


def _residual_sections(result: HandEyeResult) -> dict[str, list[tuple[str, str]]]:
    names, dropped = result.sample_names, tuple(result.dropped)
    caption = "Red: left out. Bars may be cut at the top." if dropped else ""
    sections = {
        "Residual of each sample": [
            (plots.plot_bars(names, {"position": result.residuals_mm}, "mm", dropped), caption),
            (plots.plot_bars(names, {"orientation": result.residuals_deg}, "°", dropped), caption),
        ]
    }
    if result.residuals_px is not None:
        series = {} if result.initial_px is None else {"closed form": result.initial_px}
        plot = plots.plot_bars(names, series | {"refined": result.residuals_px}, "px", dropped)
        legend = "Blue: refined; grey: closed form." if series else "Blue: refined."
        sections["Reprojection before and after the joint refinement"] = [(plot, f"{legend} {caption}".strip())]
    return sections


def _method_rows(result: HandEyeResult, ground_truth: np.ndarray | None) -> list[tuple[str, ...]]:
    """Return name, position, spread, and differences from the result and the ground truth of each method."""
    name = "refined" if result.residuals_px is not None else "weighted"
    found = [(name, result.T_mount_camera, result.rms_mm, result.rms_deg)]
    found += [(method.name, method.T_mount_camera, method.rms_mm, method.rms_deg) for method in result.methods]
    return [
        (
            name,
            ", ".join(f"{1e3 * value:.2f}" for value in T[:3, 3]),
            f"{rms_mm:.2f} mm, {rms_deg:.3f}°",
            _format_difference(result.T_mount_camera, T),
            "unknown" if ground_truth is None else _format_difference(ground_truth, T),
        )
        for name, T, rms_mm, rms_deg in found
    ]


def _intrinsics_content(result: IntrinsicsResult) -> dict[str, Any]:
    matrix = result.camera.matrix
    values = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *result.camera.distortion)
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    figures = {
        name: f"{value:.5g} ± {sd:.2g}{' px' if i < 4 else ''}"
        for i, (name, value, sd) in enumerate(zip(names, values, result.sd, strict=True))
    }
    figures |= {"Reprojection (rms)": f"{result.rms_px:.3f} px", "Hold-out error (rms)": f"{result.holdout_px:.3f} px"}
    rejected = tuple(result.rejected)
    errors = plots.plot_bars(result.view_names, {"reprojection": result.view_errors_px}, "px", rejected)
    caption = "Red: left out. Bars may be cut at the top." if rejected else ""
    coverage = "Corners detected in each part of the image; views left out are not counted."
    return {
        "title": "Camera calibration",
        "figures": figures,
        "matrix": None,
        "sections": {"Error of each view": [(errors, caption), (plots.plot_counts(result.coverage), coverage)]},
        "methods": [],
    }


def _format_difference(T_a: np.ndarray, T_b: np.ndarray) -> str:
    mm, deg = pose_distances_mm_deg(T_a, T_b)
    return f"{mm:.2f} mm, {deg:.3f}°"


def _format_matrix(T: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value: .6f}" for value in row) for row in T)
