"""Plots as SVG text, enough for a report: bars, points, a map of counts."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

BLUE, RED, GREY = "#2b6cb0", "#c53030", "#a0aec0"

_WIDTH, _HEIGHT, _LEFT, _FOOT, _TOP = 560, 240, 52, 40, 14


def bars(names: Sequence[str], series: dict[str, np.ndarray], unit: str, marked: Sequence[str] = ()) -> str:
    """Return bars side by side for each name; names in `marked` are drawn red."""
    top = max(float(np.max(values)) for values in series.values()) or 1.0
    # one wild sample must not flatten all others
    typical = 4.0 * max(float(np.median(values)) for values in series.values())
    top = min(top, typical) if typical > 0.0 else top
    step = (_WIDTH - _LEFT - 8) / max(len(names), 1)
    width = 0.8 * step / len(series)
    parts = [_axis(top, unit)]
    for k, (label, values) in enumerate(series.items()):
        for i, (name, value) in enumerate(zip(names, values, strict=True)):
            height = min(float(value) / top, 1.0) * (_HEIGHT - _FOOT - _TOP)
            colour = RED if name in marked else (GREY if k < len(series) - 1 else BLUE)
            hint = f"<title>{escape(f'{name} {label}: {value:.3g} {unit}')}</title>"
            parts.append(
                f'<rect x="{_LEFT + i * step + k * width:.1f}" y="{_HEIGHT - _FOOT - height:.1f}" width="{width:.1f}" '
                f'height="{height:.1f}" fill="{colour}">{hint}</rect>'
            )
    every = max(1, len(names) // 12)
    parts += [
        _text(_LEFT + (i + 0.4) * step, _HEIGHT - _FOOT + 14, name, "middle")
        for i, name in list(enumerate(names))[::every]
    ]
    legend = " · ".join(series) + (" (red: left out; bars may be cut at the top)" if marked else "")
    return _svg(_WIDTH, _HEIGHT, [*parts, _text(_LEFT, _HEIGHT - 6, legend, "start")])


def points(at: np.ndarray, size: tuple[int, int], caption: str) -> str:
    """Return a map of points (N, 2) [px] in an image of `size`."""
    width, height = size
    radius = max(width, height) / 250
    dots = "".join(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="{radius:.1f}"/>' for u, v in at)
    frame = f'<rect width="{width}" height="{height}" fill="none" stroke="{GREY}" stroke-width="{radius:.1f}"/>'
    inner = f'<svg viewBox="0 0 {width} {height}" height="200"><g fill="{BLUE}" opacity="0.5">{dots}</g>{frame}</svg>'
    return f"<figure>{inner}<figcaption>{escape(caption)}</figcaption></figure>"


def counts(cells: np.ndarray, caption: str) -> str:
    """Return a map of counts (R, C): the darker the more, red where there is none."""
    rows, columns = cells.shape
    parts = []
    for (row, column), n in np.ndenumerate(cells):
        fill = f'fill="{BLUE}" fill-opacity="{0.15 + 0.85 * n / max(cells.max(), 1):.2f}"' if n else f'fill="{RED}"'
        parts.append(f'<rect x="{40 * column}" y="{40 * row}" width="39" height="39" {fill}/>')
        parts.append(_text(40 * column + 20, 40 * row + 25, str(n), "middle"))
    return f"<figure>{_svg(40 * columns, 40 * rows, parts)}<figcaption>{escape(caption)}</figcaption></figure>"


def directions(vectors: np.ndarray, caption: str) -> str:
    """Return vectors (N, 3) in three views, x-y, x-z and y-z, with a common scale."""
    reach = 1.1 * max(float(np.abs(vectors).max(initial=0.0)), 1e-9)
    parts = []
    for k, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        left = 10 + 185 * k
        parts.append(f'<rect x="{left}" y="10" width="170" height="170" fill="none" stroke="{GREY}"/>')
        parts.append(f'<path d="M{left} 95h170M{left + 85} 10v170" stroke="{GREY}" stroke-width="0.5"/>')
        parts.append(_text(left + 164, 92, "xyz"[a], "end") + _text(left + 89, 22, "xyz"[b], "start"))
        for v in vectors:
            x, y = left + 85 * (1 + v[a] / reach), 10 + 85 * (1 - v[b] / reach)
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{BLUE}"/>')
    return f"<figure>{_svg(560, 190, parts)}<figcaption>{escape(f'{caption}; edge {reach:.0f}')}</figcaption></figure>"


def _axis(top: float, unit: str) -> str:
    lines = []
    for share in (0.0, 0.5, 1.0):
        y = _HEIGHT - _FOOT - share * (_HEIGHT - _FOOT - _TOP)
        lines.append(f'<path d="M{_LEFT} {y:.1f}H{_WIDTH}" stroke="{GREY}" stroke-width="0.5"/>')
        lines.append(_text(_LEFT - 4, y + 4, f"{share * top:.2g} {unit}", "end"))
    return "".join(lines)


def _text(x: float, y: float, words: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(words)}</text>'


def _svg(width: int, height: int, parts: Sequence[str]) -> str:
    return f'<svg viewBox="0 0 {width} {height}" width="{width}" font-size="11">{"".join(parts)}</svg>'
