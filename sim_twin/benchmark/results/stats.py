"""The statistics that a comparison of success rates needs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import binom

from hal.base.errors import InvalidValueError


class Interval(NamedTuple):
    """A range of rates."""

    low: float
    high: float


def wilson(successes: int, trials: int, z: float = 1.96) -> Interval:
    """Return the Wilson score interval of a rate (Wilson 1927), by default of 95 %.

    Raises:
        ValueError: the counts contradict each other.
    """
    if not 0 <= successes <= trials:
        raise InvalidValueError(f"{successes} successes in {trials} trials cannot be.")
    if trials == 0:
        return Interval(0.0, 1.0)
    rate = successes / trials
    centre = rate + z * z / (2.0 * trials)
    half = z * np.sqrt(rate * (1.0 - rate) / trials + z * z / (4.0 * trials * trials))
    scale = 1.0 + z * z / trials
    return Interval(float(max((centre - half) / scale, 0.0)), float(min((centre + half) / scale, 1.0)))


class McNemar(NamedTuple):
    """A paired comparison of two methods on the same scenarios."""

    only_first: int
    """Scenarios that only the first solved."""
    only_second: int
    """Scenarios that only the second solved."""
    p: float
    """Two-sided exact p (the binomial form of McNemar 1947)."""


def mcnemar(first: np.ndarray, second: np.ndarray) -> McNemar:
    """Compare successes (N,) bool of two methods, scenario by scenario.

    Raises:
        ValueError: the lengths differ.
    """
    first, second = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if first.shape != second.shape:
        raise InvalidValueError(f"{first.shape} and {second.shape}: paired methods need the very same scenarios.")
    b, c = int((first & ~second).sum()), int((~first & second).sum())
    p = min(1.0, 2.0 * float(binom.cdf(min(b, c), b + c, 0.5))) if b + c else 1.0
    return McNemar(b, c, p)


def paired_difference(first: np.ndarray, second: np.ndarray) -> Interval:
    """Return the 95 % interval of the first's rate less the second's, on the very same scenarios (N,) bool.

    Newcombe's score interval for paired proportions (Statistics in Medicine 17, 1998, method 10): Wilson's intervals of
    both rates, joined by how much the two agree.

    Raises:
        ValueError: the lengths differ, or there is no scenario.
    """
    b, c, _ = mcnemar(first, second)
    n = len(first)
    if not n:
        raise InvalidValueError("a difference needs scenarios that both methods ran.")
    both = int((np.asarray(first, dtype=bool) & np.asarray(second, dtype=bool)).sum())
    neither = n - both - b - c
    rates = (both + b) / n, (both + c) / n
    (low1, high1), (low2, high2) = wilson(both + b, n), wilson(both + c, n)
    agreement = both * neither - b * c
    if agreement > 0:
        agreement = max(agreement - n / 2, 0)  # the correction for continuity of method 10
    spread = float(np.sqrt(float(both + b) * (c + neither) * (both + c) * (b + neither)))
    phi = agreement / spread if spread else 0.0
    down, up = (rates[0] - low1, high2 - rates[1]), (high1 - rates[0], rates[1] - low2)
    half = [np.sqrt(max(x * x - 2.0 * phi * x * y + y * y, 0.0)) for x, y in (down, up)]
    difference = rates[0] - rates[1]
    return Interval(float(difference - half[0]), float(difference + half[1]))
