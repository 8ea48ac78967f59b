"""Solids of revolution, hollow ones too, as convex pieces for a physics engine."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

_CIRCLE_CORNERS = 20
_MIN_RADIUS_M = 1e-4


def split_turned_solid(outline: np.ndarray, rounding_m: float = 0.0) -> list[np.ndarray]:
    """Return the corners (K, 3) of convex pieces [m] that together fill `outline` (N, 2) turned about z.

    Between two neighbouring corners' heights the outline is a stack of trapezia: one on the axis gives a frustum, one
    off it a ring of wedges.

    Args:
        outline: closed polygon of (radius, height) [m].
        rounding_m: distance of the surface beyond the outline; only used without a hollow [m].
    """
    pieces = []
    # To the micrometre, so that corners of one height are one level below
    outline = np.round(outline, 6)
    low, high = outline[:, 1].min(), outline[:, 1].max()
    for between, trapezia in _strips(outline):
        z = between + rounding_m * np.array([-1.0 * (between[0] == low), 1.0 * (between[1] == high)])
        for inner, outer in trapezia:
            if inner.max() < _MIN_RADIUS_M:
                pieces.append(_frustum(outer + rounding_m, z))
            else:
                pieces += _wedges(inner, outer, z)
    return pieces


def _strips(outline: np.ndarray) -> Iterator[tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]]:
    """Yield lower and upper height (2,), and the radii ((2,), (2,)) of the trapezia between them."""
    start, end = outline, np.roll(outline, -1, axis=0)
    heights = np.unique(outline[:, 1])
    for z in pairwise(heights):
        spans = (np.minimum(start[:, 1], end[:, 1]) < z[0] + 1e-6) & (np.maximum(start[:, 1], end[:, 1]) > z[1] - 1e-6)
        a, b = start[spans], end[spans]
        fraction = (np.array(z) - a[:, 1:]) / (b[:, 1:] - a[:, 1:])
        radii = a[:, :1] + fraction * (b[:, :1] - a[:, :1])  # (edges, 2)
        radii = radii[np.argsort(radii.sum(axis=1))]
        yield np.array(z), list(zip(radii[::2], radii[1::2], strict=True))


def _frustum(radii: np.ndarray, z: np.ndarray) -> np.ndarray:
    angle = 2.0 * np.pi * np.arange(_CIRCLE_CORNERS) / _CIRCLE_CORNERS
    return np.concatenate([_circle(r, angle, height) for r, height in zip(radii, z, strict=True)])


def _wedges(inner: np.ndarray, outer: np.ndarray, z: np.ndarray) -> list[np.ndarray]:
    pieces = []
    for k in range(_CIRCLE_CORNERS):
        angle = 2.0 * np.pi * np.array([k, k + 1]) / _CIRCLE_CORNERS
        rims = [_circle(radii[end], angle, z[end]) for radii in (inner, outer) for end in (0, 1)]
        pieces.append(np.concatenate(rims))
    return pieces


def _circle(radius: float, angle: np.ndarray, height: float) -> np.ndarray:
    radius = max(radius, _MIN_RADIUS_M)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(len(angle), height)])
