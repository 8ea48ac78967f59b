"""One HTML file, complete in itself, that shows whether a calibration can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from calibration import plots
from calibration.board.detection import BoardView
from calibration.hand_eye.result import HandEyeResult
from calibration.hand_eye.uncertainty import COVERAGE
from calibration.intrinsics import IntrinsicsResult
from calibration.results import Calibration
from calibration.transforms import distance, inverse, rotation_vectors

_STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#1a202c}
h1,h2{line-height:1.2}figure{margin:1rem 0}figcaption{color:#4a5568}table{border-collapse:collapse}
td,th{padding:.2rem .8rem .2rem 0;text-align:left;border-bottom:1px solid #e2e8f0;vertical-align:top}
pre{background:#f7fafc;padding:.6rem}.warn{background:#fffaf0;border-left:4px solid #dd6b20;padding:.4rem .8rem}"""


def write_report(
    path: Path,
    calibration: Calibration,
    result: HandEyeResult | IntrinsicsResult,
    *,
    views: Sequence[BoardView] = (),
    Ts_base_flange: np.ndarray | None = None,
    T_mount_camera_truth: np.ndarray | None = None,
) -> None:
    """Write the report of `result`.

    Args:
        path: of the HTML file; it is replaced.
        calibration: the result's origin, as saved.
        result: what is shown.
        views: one a sample, for the map of where corners were seen.
        Ts_base_flange: (N, 4, 4) the arm's poses, for the spread of the rotation axes (hand-eye).
        T_mount_camera_truth: (4, 4) the true camera pose, where it is known.
    """
    if isinstance(result, HandEyeResult):
        title, body = "Hand-eye calibration", _hand_eye(result, Ts_base_flange, T_mount_camera_truth)
    else:
        title, body = "Camera calibration", _intrinsics(result)
    parts = [f"<h1>{title}</h1>", _origin(calibration), _doubts(calibration), *body]
    if views:
        pixels = np.vstack([view.pixels_px for view in views])
        parts += ["<h2>Coverage</h2>", plots.points(pixels, views[0].image_size, "All corners seen, in the image.")]
    head = f"<!doctype html><html lang='en'><meta charset='utf-8'><title>{title}</title><style>{_STYLE}</style>"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(head + "\n".join(parts) + "</html>\n", encoding="utf-8")


def _origin(calibration: Calibration) -> str:
    board, used, dropped = calibration.board, calibration.samples["used"], calibration.samples["dropped"]
    return _table(
        {
            "Camera": calibration.serial,
            "Date": calibration.date,
            "File": str(calibration.path or "not saved"),
            "Board": f"{board.columns} × {board.rows}, squares {1e3 * board.square_m:g} mm, {board.dictionary}",
            "Samples": f"{len(used)} used, {len(dropped)} left out, from {calibration.samples['folder']}",
            **{f"left out: {name}": reason for name, reason in dropped.items()},
        }
    )


def _doubts(calibration: Calibration) -> str:
    return "".join(f"<p class='warn'>{escape(doubt)}</p>" for doubt in calibration.doubts())


def _hand_eye(result: HandEyeResult, Ts_base_flange: np.ndarray | None, truth: np.ndarray | None) -> list[str]:
    mount = "flange" if result.setup == "eye_in_hand" else "base"
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
    if truth is not None:
        mm, deg = distance(result.T_mount_camera, truth)
        figures["Error against the truth"] = f"{mm:.3f} mm, {deg:.4f}°"
    left_out = tuple(result.dropped)
    parts = [_table(figures), f"<h2>T_{mount}_camera</h2><pre>{_matrix(result.T_mount_camera)}</pre>"]
    parts.append("<h2>Residual of each sample</h2>")
    parts.append(plots.bars(result.sample_names, {"position": result.residuals_mm}, "mm", left_out))
    parts.append(plots.bars(result.sample_names, {"orientation": result.residuals_deg}, "°", left_out))
    if result.residuals_px is not None:
        series = {} if result.initial_px is None else {"closed form": result.initial_px}
        parts.append("<h2>Reprojection before and after the joint refinement</h2>")
        parts.append(plots.bars(result.sample_names, series | {"refined": result.residuals_px}, "px", left_out))
    if Ts_base_flange is not None:
        T_mounts = Ts_base_flange if result.setup == "eye_in_hand" else inverse(Ts_base_flange)
        turns = np.degrees(rotation_vectors(np.swapaxes(T_mounts[:1, :3, :3], 1, 2) @ T_mounts[:, :3, :3]))
        parts.append("<h2>Spread of the rotations</h2>")
        parts.append(plots.directions(turns, f"Rotation from the first sample, axis times angle in {mount} axes [°]"))
    parts.append("<h2>Methods</h2>" + _methods(result, truth))
    return parts


def _methods(result: HandEyeResult, truth: np.ndarray | None) -> str:
    rows = [("refined" if result.residuals_px is not None else "weighted", result.T_mount_camera)]
    rows += [(method.name, method.T_mount_camera) for method in result.methods]
    spread = {method.name: f"{method.rms_mm:.2f} mm, {method.rms_deg:.3f}°" for method in result.methods}
    lines = [
        "<tr><th>method</th><th>position [mm]</th><th>spread</th><th>from the result</th><th>from the truth</th></tr>"
    ]
    for name, T in rows:
        away = "{:.2f} mm, {:.3f}°".format(*distance(result.T_mount_camera, T))
        wrong = "unknown" if truth is None else "{:.2f} mm, {:.3f}°".format(*distance(truth, T))
        place = ", ".join(f"{1e3 * value:.2f}" for value in T[:3, 3])
        own = spread.get(name, f"{result.rms_mm:.2f} mm, {result.rms_deg:.3f}°")
        lines.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in (name, place, own, away, wrong)) + "</tr>")
    return f"<table>{''.join(lines)}</table>"


def _intrinsics(result: IntrinsicsResult) -> list[str]:
    matrix = result.camera.matrix
    values = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *result.camera.distortion)
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    figures = {
        name: f"{value:.5g} ± {sd:.2g}{' px' if i < 4 else ''}"
        for i, (name, value, sd) in enumerate(zip(names, values, result.sd, strict=True))
    }
    figures |= {"Reprojection (rms)": f"{result.rms_px:.3f} px", "Hold-out error (rms)": f"{result.holdout_px:.3f} px"}
    return [
        _table(figures),
        "<h2>Error of each view</h2>",
        plots.bars(result.view_names, {"reprojection": result.view_errors_px}, "px", tuple(result.refused)),
        plots.counts(result.coverage, "Corners seen in each part of the image, views left out not counted."),
    ]


def _table(rows: dict[str, str]) -> str:
    lines = (f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows.items())
    return f"<table>{''.join(lines)}</table>"


def _matrix(T: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value: .6f}" for value in row) for row in T)
