"""The reports' plots as inline SVG by matplotlib: rate bars, mode bars, grids and curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from io import StringIO
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from sim_twin.benchmark.results.stats import wilson

COLOURS = ("#7c8ba1", "#2b6cb0", "#2f855a", "#b7791f", "#805ad5", "#c05621", "#319795", "#97266d")
"""Of methods, in their order."""
_GREEN, _INK, _RULE, _EMPTY = "#68a67d", "#1a202c", "#cbd5e0", "#edf2f7"
_CAUSES = ("#c53030", "#dd6b20", "#d69e2e", "#805ad5", "#3182ce", "#319795", "#97266d", "#718096", "#4a5568", "#b83280")
_BLUES = LinearSegmentedColormap.from_list("rates", ["#ebf3fb", "#1a4982"])
_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 8.5,
    "text.color": _INK,
    "axes.edgecolor": _RULE,
    "axes.labelcolor": _INK,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "svg.fonttype": "none",  # text stays text: small files that can be searched
    "svg.hashsalt": "z1-grasp",  # the same figures give the same bytes
}
_BAR_IN, _GAP_IN, _PLOT_IN, _CELL_IN = 0.195, 0.14, 3.5, (1.03, 0.61)
_LETTER_IN = 0.075
"""Width of a letter of 8.5 pt at most, on average [in]."""

Counts = tuple[int, int]
"""Successes and episodes."""
Point = tuple[float, int, int]
"""Position along x in [0, 1], successes and episodes."""
Keys = Sequence[tuple[str, str]]
"""Names of a legend with their colours."""


class Plot(NamedTuple):
    """An SVG image and its caption."""

    svg: str
    caption: str


def method_keys(names: Sequence[str]) -> Keys:
    """Return the colour of each method."""
    return [(name, COLOURS[k % len(COLOURS)]) for k, name in enumerate(names)]


def plot_rate_bars(groups: Sequence[str], series: Mapping[str, Sequence[Counts]], caption: str) -> Plot:
    """Return bars of success rates with their 95 % intervals, for each group one bar per series.

    Args:
        groups: labels at the left.
        series: for each name one count per group; a bar of no episodes is left out and labelled so.
        caption: below the plot.
    """
    group_in = len(series) * _BAR_IN + _GAP_IN
    canvas = _Canvas(_PLOT_IN, len(groups) * group_in, _text_width(groups), right_in=1.25)
    axes = canvas.axes
    for row, _ in enumerate(groups):
        for (name, colour), counts in zip(method_keys(list(series)), series.values(), strict=True):
            (successes, n), number = counts[row], list(series).index(name)
            y = row * group_in + _GAP_IN / 2 + (number + 0.5) * _BAR_IN
            if not n:
                axes.text(0.01, y, "no episodes", va="center")
                continue
            rate, (low, high) = successes / n, wilson(successes, n)
            (bar,) = axes.barh(y, rate, 0.78 * _BAR_IN, color=colour)
            canvas.add_hint(bar, f"{name}, {groups[row]}: {_describe(successes, n)}")
            axes.errorbar(rate, y, xerr=[[rate - low], [high - rate]], color=_INK, capsize=2, linewidth=0.8)
            axes.text(1.03, y, f"{rate:.1%} of {n}", va="center", clip_on=False)
    axes.set(xlim=(0, 1), ylim=(len(groups) * group_in, 0))
    axes.set_yticks([(row + 0.5) * group_in for row in range(len(groups))], groups)
    axes.set_xticks(np.linspace(0, 1, 5), [f"{rate:.0%}" for rate in np.linspace(0, 1, 5)])
    axes.xaxis.tick_top()
    axes.grid(axis="x", color=_RULE, linewidth=0.6)
    return canvas.to_plot(caption)


def mode_keys(rows: Mapping[str, Mapping[str, int]], first: str) -> Keys:
    """Return the colour of each mode in `rows`; `first` comes first and green."""
    names = sorted({name for counts in rows.values() for name in counts} - {first})
    return [(first, _GREEN), *((name, _CAUSES[k % len(_CAUSES)]) for k, name in enumerate(names))]


def plot_mode_bars(rows: Mapping[str, Mapping[str, int]], keys: Keys, caption: str) -> Plot:
    """Return one bar per row, divided by its counts."""
    canvas = _Canvas(2 * _PLOT_IN, 0.42 * len(rows), _text_width(list(rows)), top_in=0.05)
    for row, (label, counts) in enumerate(rows.items()):
        start, total = 0.0, max(sum(counts.values()), 1)
        for name, colour in keys:
            if not (count := counts.get(name, 0)):
                continue
            (bar,) = canvas.axes.barh(row, count / total, 0.7, left=start, color=colour)
            canvas.add_hint(bar, f"{label}: {name} {count} of {total}")
            if count / total > 0.045:  # narrower bars have no room for their figure
                canvas.axes.text(start + count / total / 2, row, str(count), ha="center", va="center", color="#fff")
            start += count / total
    canvas.axes.set(xlim=(0, 1), ylim=(len(rows) - 0.5, -0.5), xticks=[])
    canvas.axes.set_yticks(range(len(rows)), list(rows))
    return canvas.to_plot(caption)


def plot_rate_grid(
    rows: Sequence[str], columns: Sequence[str], cells: Mapping[tuple[str, str], Counts], caption: str
) -> Plot:
    """Return a grid of success rates by row and column: the darker the higher."""
    texts = {key: (s / n, f"{s / n:.0%}", f"{s} of {n}") for key, (s, n) in cells.items() if n}
    return _plot_grid(rows, columns, texts, caption)


def plot_count_grid(
    rows: Sequence[str],
    columns: Sequence[str],
    cells: Mapping[tuple[str, str], tuple[int, str]],
    maximum: int,
    caption: str,
) -> Plot:
    """Return a grid of counts with a word below each: the darker the higher, `maximum` being the darkest."""
    # The square root keeps small counts apart: they decide whether a scenario can be solved
    shades = {key: float(np.sqrt(min(count / max(maximum, 1), 1.0))) for key, (count, _) in cells.items()}
    return _plot_grid(rows, columns, {key: (shades[key], str(n), word) for key, (n, word) in cells.items()}, caption)


def plot_rate_curves(
    series: Mapping[str, Sequence[Point]], x_label: str, caption: str, *, diagonal: bool = False
) -> Plot:
    """Return success rates with their 95 % intervals over a number in [0, 1], one line per name.

    Args:
        series: points in the order of x.
        x_label: below the axis.
        caption: below the plot.
        diagonal: whether to draw the line of equality.
    """
    canvas = _Canvas(5.3, 3.1, 0.35, top_in=0.1, bottom_in=0.5)
    axes = canvas.axes
    if diagonal:
        axes.plot([0, 1], [0, 1], color="#718096", linestyle="--", linewidth=1)
    for (name, colour), points in zip(method_keys(list(series)), series.values(), strict=True):
        known = [(x, successes, n) for x, successes, n in points if n]
        axes.plot([x for x, _, _ in known], [successes / n for _, successes, n in known], color=colour)
        for x, successes, n in known:
            low, high = wilson(successes, n)
            axes.plot([x, x], [low, high], color=colour, alpha=0.5, linewidth=1)
            # One artist a point, as a hint belongs to an artist
            (dot,) = axes.plot([x], [successes / n], "o", color=colour, markersize=4)
            canvas.add_hint(dot, f"{name}, {x:.3g}: {_describe(successes, n)}")
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), xlabel=x_label)
    axes.set_xticks(np.linspace(0, 1, 5))
    axes.set_yticks(np.linspace(0, 1, 5), [f"{rate:.0%}" for rate in np.linspace(0, 1, 5)])
    axes.grid(axis="y", color=_RULE, linewidth=0.6)
    return canvas.to_plot(caption)


class _Canvas:
    """One figure with one pair of axes of a fixed size [in], and hints that browsers show under the pointer."""

    def __init__(
        self,
        width_in: float,
        height_in: float,
        left_in: float,
        *,
        right_in: float = 0.1,
        top_in: float = 0.3,
        bottom_in: float = 0.05,
    ) -> None:
        with mpl.rc_context(_STYLE):
            size = (left_in + width_in + right_in, bottom_in + height_in + top_in)
            self._figure = Figure(figsize=size)
            box = (left_in / size[0], bottom_in / size[1], width_in / size[0], height_in / size[1])
            self.axes: Axes = self._figure.add_axes(box)
        self.axes.set_axisbelow(True)
        self.axes.spines[:].set_visible(False)
        self.axes.tick_params(length=0, pad=5)
        self._hints: dict[str, str] = {}

    def add_hint(self, artist: Artist, text: str) -> None:
        """Show `text` where the pointer rests on `artist`."""
        name = f"hint{len(self._hints)}"
        artist.set_gid(name)
        self._hints[name] = text

    def to_plot(self, caption: str) -> Plot:
        """Return the figure as SVG."""
        file = StringIO()
        with mpl.rc_context(_STYLE):
            self._figure.savefig(
                file, format="svg", transparent=True, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
            )
        svg = file.getvalue()
        # HTML does not allow the XML declaration
        svg = svg[svg.index("<svg") :]
        for name, text in self._hints.items():
            svg = svg.replace(f'<g id="{name}">', f"<g><title>{escape(text)}</title>")
        return Plot(svg, caption)


def _plot_grid(
    rows: Sequence[str], columns: Sequence[str], cells: Mapping[tuple[str, str], tuple[float, str, str]], caption: str
) -> Plot:
    """Return a grid of cells, each a darkness in [0, 1], a figure and a word below it; cells without are pale."""
    width_in, height_in = len(columns) * _CELL_IN[0], len(rows) * _CELL_IN[1]
    canvas = _Canvas(width_in, height_in, _text_width(rows))
    for r, row in enumerate(rows):
        for c, column in enumerate(columns):
            shade, figure, word = cells.get((row, column), (0.0, "–", ""))
            face = _BLUES(shade) if (row, column) in cells else _EMPTY
            canvas.axes.bar(c, 1, 1, bottom=r - 0.5, color=face, edgecolor="#fff")
            ink = "#fff" if shade > 0.55 else _INK
            canvas.axes.text(c, r - 0.16, figure, ha="center", va="center", color=ink)
            canvas.axes.text(c, r + 0.2, word, ha="center", va="center", color=ink)
    canvas.axes.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(rows) - 0.5, -0.5))
    canvas.axes.set_xticks(range(len(columns)), columns)
    canvas.axes.set_yticks(range(len(rows)), rows)
    canvas.axes.xaxis.tick_top()
    return canvas.to_plot(caption)


def _describe(successes: int, n: int) -> str:
    low, high = wilson(successes, n)
    return f"{successes} of {n}, {successes / n:.1%} ({low:.1%} to {high:.1%})"


def _text_width(words: Sequence[str]) -> float:
    return 0.2 + _LETTER_IN * max(map(len, words), default=0)
