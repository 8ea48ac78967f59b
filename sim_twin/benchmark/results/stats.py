"""Statistics of a comparison of success rates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import binomtest

from hal.base.errors import InvalidValueError


class Interval(NamedTuple):
    """Bounds of a rate."""

    low: float
    high: float


def wilson(successes: int, trials: int) -> Interval:
    """Return the 95 % Wilson score interval of a rate (Wilson 1927).

    Raises:
        InvalidValueError: the counts contradict each other.
    """
    if not 0 <= successes <= trials:
        raise InvalidValueError(
            f"success rate: the counts are {successes} of {trials} trials, allowed are 0 to {trials} successes. "
            "Count successes and trials of the same rows.",
            code="invalid_counts",
        )
    if trials == 0:
        return Interval(0.0, 1.0)
    interval = binomtest(successes, trials).proportion_ci(method="wilson")
    return Interval(float(interval.low), float(interval.high))


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
        InvalidValueError: the lengths differ.
    """
    first, second = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if first.shape != second.shape:
        raise InvalidValueError(
            f"McNemar's test: the shapes are {first.shape} and {second.shape}, allowed are equal ones. "
            "Give both methods the same scenarios.",
            code="unpaired",
        )
    b, c = int((first & ~second).sum()), int((~first & second).sum())
    # Only discordant pairs carry information; without one there is no test
    return McNemar(b, c, float(binomtest(min(b, c), b + c).pvalue) if b + c else 1.0)


def paired_difference(first: np.ndarray, second: np.ndarray) -> Interval:
    """Return the 95 % interval of the first's rate minus the second's, on the same scenarios (N,) bool.

    Newcombe's score interval for paired proportions (Statistics in Medicine 17, 1998, method 10): Wilson's intervals of
    both rates, combined by the correlation of the two.

    Raises:
        InvalidValueError: the lengths differ, or there is no scenario.
    """
    b, c, _ = mcnemar(first, second)
    n = len(first)
    if not n:
        raise InvalidValueError(
            "paired difference: no scenario is shared (0, allowed 1 or more). Run both methods on the same scenarios.",
            code="no_scenarios",
        )
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
