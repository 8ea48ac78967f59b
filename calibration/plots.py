"""Plots of the report as SVG text: bars, points in an image, a map of counts, rotation vectors."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

_BLUE, _RED, _GREY = "#2b6cb0", "#c53030", "#a0aec0"
# Text stays text, and a fixed salt makes the element names, and so the file, the same each time
_STYLE: Any = {"svg.fonttype": "none", "svg.hashsalt": "calibration", "font.size": 8.0}
_NO_METADATA: Any = dict.fromkeys(("Creator", "Date", "Format", "Type"))


def plot_bars(names: Sequence[str], series: dict[str, np.ndarray], unit: str, marked: Sequence[str] = ()) -> str:
    """Return grouped bars with their values for each name; names in `marked` are drawn red."""
    top = max(float(np.max(values)) for values in series.values()) or 1.0
    # Four medians: one outlier must not flatten all other bars
    typical = 4.0 * max(float(np.median(values)) for values in series.values())
    top = min(top, typical) if typical > 0.0 else top
    figure, (axes,) = _new_figure(5.8, 2.6)
    width = 0.8 / len(series)
    for k, (label, values) in enumerate(series.items()):
        x = np.arange(len(names)) + (k - 0.5 * (len(series) - 1)) * width
        colour = _BLUE if k == len(series) - 1 else _GREY
        drawn = axes.bar(
            x,
            np.minimum(values, top),
            width,
            label=label,
            color=[_RED if name in marked else colour for name in names],
        )
        axes.bar_label(drawn, [f"{value:.2g}" for value in values], rotation=90, fontsize=5, padding=1)
    axes.set(ylabel=f"{', '.join(series)} [{unit}]", ylim=(0.0, 1.15 * top))
    axes.set_xticks(np.arange(len(names)), names, rotation=90 if len(names) > 12 else 0)
    return _svg(figure)


def plot_points(pixels_px: np.ndarray, size: tuple[int, int]) -> str:
    """Return a map of points (N, 2) [px] in an image of `size`."""
    figure, (axes,) = _new_figure(3.6, 2.7)
    axes.plot(*pixels_px.T, ".", color=_BLUE, alpha=0.5, markersize=2)
    axes.set(xlim=(-0.5, size[0] - 0.5), ylim=(size[1] - 0.5, -0.5), aspect="equal", xlabel="u [px]", ylabel="v [px]")
    return _svg(figure)


def plot_counts(cells: np.ndarray) -> str:
    """Return a map of counts (R, C): darker for more, red for zero."""
    figure, (axes,) = _new_figure(0.5 * cells.shape[1], 0.5 * cells.shape[0])
    axes.set(xlim=(-0.5, cells.shape[1] - 0.5), ylim=(cells.shape[0] - 0.5, -0.5), xticks=[], yticks=[])
    for (row, column), count in np.ndenumerate(cells):
        alpha = 0.15 + 0.85 * count / max(cells.max(), 1)
        colour = to_rgba(_BLUE, alpha) if count else _RED
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1.0, 1.0, facecolor=colour, edgecolor="white"))
        axes.text(column, row, str(count), ha="center", va="center")
    return _svg(figure)


def plot_rotations(vectors_deg: np.ndarray) -> str:
    """Return rotation vectors (N, 3) [°] in three views, x-y, x-z and y-z, with a common scale."""
    limit = 1.1 * max(float(np.abs(vectors_deg).max(initial=0.0)), 1e-9)
    figure, all_axes = _new_figure(7.0, 2.4, columns=3)
    for axes, (a, b) in zip(all_axes, ((0, 1), (0, 2), (1, 2)), strict=True):
        axes.plot(vectors_deg[:, a], vectors_deg[:, b], "o", color=_BLUE, markersize=3)
        axes.axhline(0.0, color=_GREY, linewidth=0.5)
        axes.axvline(0.0, color=_GREY, linewidth=0.5)
        axes.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
        axes.set(xlabel=f"{'xyz'[a]} [°]", ylabel=f"{'xyz'[b]} [°]")
    return _svg(figure)


def _new_figure(width_in: float, height_in: float, columns: int = 1) -> tuple[Figure, list[Axes]]:
    with mpl.rc_context(_STYLE):
        # Not pyplot: its figures are global, and it would pick a window toolkit
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        return figure, list(figure.subplots(1, columns, squeeze=False)[0])


def _svg(figure: Figure) -> str:
    text = io.StringIO()
    with mpl.rc_context(_STYLE):
        figure.savefig(text, format="svg", metadata=_NO_METADATA)
    return text.getvalue()[text.getvalue().index("<svg") :]  # without the XML declaration, which HTML does not allow
