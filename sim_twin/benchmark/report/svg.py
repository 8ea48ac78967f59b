"""The benchmark report's plots as SVG text: bars with intervals, shares of a whole, a grid of rates.

Bars lie on their side, one line each, with the words left and the figure right of them: names of any length and any
number of methods have room.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from sim_twin.benchmark.results.stats import wilson

COLOURS = ("#7c8ba1", "#2b6cb0", "#2f855a", "#b7791f", "#805ad5", "#c05621", "#319795", "#97266d")
"""Of methods, in their order."""
_GREEN, _INK, _RULE = "#68a67d", "#1a202c", "#cbd5e0"
_CAUSES = ("#c53030", "#dd6b20", "#d69e2e", "#805ad5", "#3182ce", "#319795", "#97266d", "#718096", "#4a5568", "#b83280")
_BAR, _STEP, _GAP, _PLOT, _TOP = 11, 14, 10, 250, 18
_LETTER = 6.4
"""Width that a letter of 11 px takes at most, on average [px]."""

Tally = tuple[int, int]
"""Successes and episodes."""


def legend(names: Sequence[str], colours: Sequence[str] = COLOURS) -> str:
    """Return a line of names with their colours, which wraps by itself."""
    keys = (
        f"<span><i style='background:{colours[k % len(colours)]}'></i>{escape(name)}</span>"
        for k, name in enumerate(names)
    )
    return f"<p class='legend'>{''.join(keys)}</p>"


def rate_bars(groups: Sequence[str], series: Mapping[str, Sequence[Tally]], caption: str) -> str:
    """Return bars of success rates with their 95 % intervals, for each group one bar a series.

    Args:
        groups: what stands left of each group.
        series: for each name one tally a group; a bar of no episodes is left out and says so.
        caption: below the plot.
    """
    left = _room(groups)
    parts = [_rate_axis(left, len(groups) * (len(series) * _STEP + _GAP))]
    for row, group in enumerate(groups):
        top = _TOP + row * (len(series) * _STEP + _GAP)
        parts.append(_text(left - 8, top + len(series) * _STEP / 2 + 3, group, "end"))
        for k, (name, tallies) in enumerate(series.items()):
            successes, n = tallies[row]
            y = top + k * _STEP
            if n == 0:
                parts.append(_text(left + 4, y + 9, "no episodes", "start"))
                continue
            rate, (low, high) = successes / n, wilson(successes, n)
            hint = f"{name}, {group}: {successes} of {n}, {rate:.1%} ({low:.1%} to {high:.1%})"
            parts.append(_bar(left, y, _PLOT * rate, COLOURS[k % len(COLOURS)], hint))
            a, b = left + _PLOT * low, left + _PLOT * high
            parts.append(f'<path d="M{a:.1f} {y + 5.5}H{b:.1f}M{a:.1f} {y + 3}v5M{b:.1f} {y + 3}v5" stroke="{_INK}"/>')
            parts.append(_text(left + _PLOT + 10, y + 9, f"{rate:.1%} of {n}", "start"))
    height = _TOP + len(groups) * (len(series) * _STEP + _GAP)
    return _figure(left + _PLOT + 100, height, parts, caption)


def share_bars(rows: Mapping[str, Mapping[str, int]], first: str, caption: str) -> str:
    """Return one bar a row, cut by its counts; `first` comes first and green. A legend with all names stands above."""
    names = [first, *sorted({name for counts in rows.values() for name in counts} - {first})]
    colours = [_GREEN, *(_CAUSES[k % len(_CAUSES)] for k in range(len(names) - 1))]
    left, width = _room(list(rows)), 2 * _PLOT
    parts = []
    for row, (label, counts) in enumerate(rows.items()):
        y, x, total = _GAP / 2 + row * 30, float(left), max(sum(counts.values()), 1)
        parts.append(_text(left - 8, y + 14, label, "end"))
        for name, colour in zip(names, colours, strict=True):
            share = width * counts.get(name, 0) / total
            if not share:
                continue
            parts.append(_bar(x, y, share, colour, f"{label}: {name} {counts[name]} of {total}", high=21))
            if share > 22:
                parts.append(_text(x + share / 2, y + 15, str(counts[name]), "middle", "#fff"))
            x += share
    return legend(names, colours) + _figure(left + width + 8, _GAP + 30 * len(rows), parts, caption)


def rate_grid(rows: Sequence[str], columns: Sequence[str], cells: Mapping[tuple[str, str], Tally], caption: str) -> str:
    """Return a grid of success rates by row and column: the darker the more."""
    return _grid(
        rows,
        columns,
        {key: (s / n, f"{s / n:.0%}", f"{s} of {n}") for key, (s, n) in cells.items() if n},
        caption,
    )


def count_grid(
    rows: Sequence[str],
    columns: Sequence[str],
    cells: Mapping[tuple[str, str], tuple[int, str]],
    most: int,
    caption: str,
) -> str:
    """Return a grid of counts with a word below each: the darker the more, `most` being the darkest."""
    shares = {key: float(np.sqrt(min(count / max(most, 1), 1.0))) for key, (count, _) in cells.items()}
    return _grid(rows, columns, {key: (shares[key], str(n), word) for key, (n, word) in cells.items()}, caption)


def _grid(
    rows: Sequence[str], columns: Sequence[str], cells: Mapping[tuple[str, str], tuple[float, str, str]], caption: str
) -> str:
    """Return a grid of cells, each a darkness in [0, 1], a figure and a word below it; those without are pale."""
    left, wide, high = _room(rows), 74, 44
    parts = [_text(left + (c + 0.5) * wide, 12, name, "middle") for c, name in enumerate(columns)]
    for r, row in enumerate(rows):
        y = _TOP + r * high
        parts.append(_text(left - 8, y + high / 2 + 4, row, "end"))
        for c, column in enumerate(columns):
            x, cell = left + c * wide, cells.get((row, column))
            share, figure, word = cell or (0.0, "–", "")
            fill, ink = _blend(share) if cell else "#edf2f7", "#fff" if share > 0.55 else _INK
            parts.append(f'<rect x="{x}" y="{y}" width="{wide - 2}" height="{high - 2}" fill="{fill}"/>')
            parts.append(_text(x + wide / 2 - 1, y + 19, figure, "middle", ink))
            parts.append(_text(x + wide / 2 - 1, y + 34, word, "middle", ink))
    return _figure(left + wide * len(columns) + 4, _TOP + high * len(rows), parts, caption)


def _rate_axis(left: float, height: float) -> str:
    lines = []
    for share in np.linspace(0.0, 1.0, 5):
        x = left + _PLOT * share
        lines.append(f'<path d="M{x:.1f} {_TOP - 4}v{height:.0f}" stroke="{_RULE}" stroke-width="0.7"/>')
        lines.append(_text(x, 10, f"{share:.0%}", "middle", "#718096"))
    return "".join(lines)


def _bar(x: float, y: float, width: float, colour: str, hint: str, *, high: float = _BAR) -> str:
    return (
        f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{high}" fill="{colour}">'
        f"<title>{escape(hint)}</title></rect>"
    )


def _blend(rate: float) -> str:
    """Return a colour from near white (0) to dark blue (1)."""
    colour = (1.0 - rate) * np.array([235, 243, 251]) + rate * np.array([26, 73, 130])
    return "#" + "".join(f"{round(float(value)):02x}" for value in colour)


def _room(words: Sequence[str]) -> float:
    return 14 + _LETTER * max(map(len, words), default=0)


def _text(x: float, y: float, words: str, anchor: str, colour: str = _INK) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}">{escape(words)}</text>'


def _figure(width: float, height: float, parts: Sequence[str], caption: str) -> str:
    size = f'viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" height="{height:.0f}"'
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-size="11">{"".join(parts)}</svg>'
    return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"
