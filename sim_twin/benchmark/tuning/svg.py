"""The tuning report's plots as SVG text: success against a weight, and how far a head's probability can be trusted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from sim_twin.benchmark.report.svg import COLOURS
from sim_twin.benchmark.results.stats import wilson

_WIDTH, _HEIGHT, _LEFT, _TOP, _BELOW = 380, 220, 48, 14, 40
_INK, _RULE = "#1a202c", "#cbd5e0"

Point = tuple[float, int, int]
"""Where it stands along x in [0, 1], successes and how many there were."""


def rate_curves(series: Mapping[str, Sequence[Point]], x_words: str, caption: str, *, diagonal: bool = False) -> str:
    """Return success rates with their 95 % intervals over a number in [0, 1], a line for each name.

    Args:
        series: points in the order of x.
        x_words: below the axis.
        caption: below the plot.
        diagonal: whether the line on which both are equal is drawn.
    """
    parts = [_axes(x_words)]
    if diagonal:
        parts.append(_path([(0.0, 0.0), (1.0, 1.0)], "#718096", dash=True))
    for k, (name, points) in enumerate(series.items()):
        colour = COLOURS[k % len(COLOURS)]
        parts.append(_path([(x, right / n) for x, right, n in points if n], colour))
        parts += [_dot(x, right, n, colour, name) for x, right, n in points if n]
    size = f'viewBox="0 0 {_LEFT + _WIDTH + 14} {_TOP + _HEIGHT + _BELOW}" width="{_LEFT + _WIDTH + 14}"'
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-size="11">{"".join(parts)}</svg>'
    return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"


def _at(x: float, y: float) -> tuple[float, float]:
    return _LEFT + x * _WIDTH, _TOP + (1.0 - y) * _HEIGHT


def _axes(words: str) -> str:
    parts = []
    for n in range(5):
        share = n / 4
        (left, y), (right, _) = _at(0.0, share), _at(1.0, share)
        parts.append(f'<path d="M{left} {y:.1f}H{right}" stroke="{_RULE}" stroke-width="0.7"/>')
        parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end" fill="{_INK}">{share:.0%}</text>')
        x, bottom = _at(share, 0.0)
        parts.append(f'<text x="{x:.1f}" y="{bottom + 15}" text-anchor="middle" fill="{_INK}">{share:g}</text>')
    x, bottom = _at(0.5, 0.0)
    parts.append(f'<text x="{x}" y="{bottom + 32}" text-anchor="middle" fill="{_INK}">{escape(words)}</text>')
    return "".join(parts)


def _path(points: Sequence[tuple[float, float]], colour: str, *, dash: bool = False) -> str:
    line = "L".join("{:.1f} {:.1f}".format(*_at(x, y)) for x, y in points)
    more = ' stroke-dasharray="4 3"' if dash else ""
    return f'<path d="M{line}" fill="none" stroke="{colour}" stroke-width="1.6"{more}/>' if points else ""


def _dot(x: float, right: int, n: int, colour: str, name: str) -> str:
    low, high = wilson(right, n)
    (at, y), (_, y_low), (_, y_high) = _at(x, right / n), _at(x, low), _at(x, high)
    hint = escape(f"{name}, {x:.3g}: {right} of {n}, {right / n:.1%} ({low:.1%} to {high:.1%})")
    return (
        f'<path d="M{at:.1f} {y_low:.1f}V{y_high:.1f}" stroke="{colour}" opacity="0.5"/>'
        f'<circle cx="{at:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"><title>{hint}</title></circle>'
    )
