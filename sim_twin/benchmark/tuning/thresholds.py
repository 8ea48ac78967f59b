"""Fit of a threshold below which grasps fail: one split of one number, tested outside of its own fold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import fisher_exact

from sim_twin.benchmark.tuning.folds import make_folds

MIN_GRASPS_PER_SIDE = 5
"""Minimum number of grasps on either side of a split."""
MAX_P = 0.05
"""Significance level of Fisher's test, the usual one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Threshold:
    """A split and its evidence."""

    value: float
    """Grasps below it failed more often."""
    below: tuple[int, int]
    """Successes and grasps below the splits of the folds that do not contain them."""
    above: tuple[int, int]
    """The same at or above them."""
    p: float
    """Fisher's exact test, one-sided, of these counts."""

    @property
    def is_significant(self) -> bool:
        """Return whether the failures below it are more than chance."""
        return self.p < MAX_P


def fit_threshold(values: np.ndarray, success: np.ndarray, poses: np.ndarray) -> Threshold | None:
    """Return the split of failures from successes with the greatest likelihood; None where no side is large enough.

    Args:
        values: (N,) of each grasp; NaN ones are left out.
        success: (N,) bool.
        poses: (N,) the scenarios without their seeds, the groups of the cross-validation.
    """
    known = np.isfinite(values)
    values, success, poses = values[known], success[known], poses[known]
    value = _best_split(values, success)
    if value is None:
        return None
    counts = np.zeros((2, 2), dtype=int)  # below, above; failures, successes
    for train, test in make_folds(poses):
        split = _best_split(values[train], success[train])
        if split is not None:
            np.add.at(counts, ((values[test] >= split).astype(int), success[test].astype(int)), 1)
    return Threshold(
        value=value,
        below=(int(counts[0, 1]), int(counts[0].sum())),
        above=(int(counts[1, 1]), int(counts[1].sum())),
        p=float(fisher_exact(counts, alternative="greater")[1]),  # pyright: ignore[reportArgumentType]
    )


def _best_split(values: np.ndarray, success: np.ndarray) -> float | None:
    """Return the midpoint between two values that gives the labels the greatest likelihood, failures below."""
    order = np.argsort(values, kind="stable")
    values, labels = values[order], success[order].astype(float)
    n, right = len(values), float(labels.sum())
    below = np.arange(1, n)
    right_below = np.cumsum(labels)[:-1]
    # Equal values cannot be split
    allowed = (below >= MIN_GRASPS_PER_SIDE) & (n - below >= MIN_GRASPS_PER_SIDE) & (np.diff(values) > 1e-9)
    allowed &= right_below / below < (right - right_below) / np.maximum(n - below, 1)
    if not allowed.any():
        return None
    fit = _log_likelihood(right_below, below) + _log_likelihood(right - right_below, n - below)
    at = int(np.argmax(np.where(allowed, fit, -np.inf)))
    return float(0.5 * (values[at] + values[at + 1]))


def _log_likelihood(right: np.ndarray, n: np.ndarray) -> np.ndarray:
    # A side without failures, or without successes, would have a logarithm of 0
    rate = np.clip(right / n, 1e-12, 1.0 - 1e-12)
    return right * np.log(rate) + (n - right) * np.log(1.0 - rate)
