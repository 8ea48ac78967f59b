"""Looks for a value below which grasps fail: one cut of one number, believed only if it holds out of its own fold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import fisher_exact

from sim_twin.benchmark.tuning.folds import make_folds

MIN_GRASPS_PER_SIDE = 5
"""Fewest grasps below a cut."""
MAX_P = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Threshold:
    """A cut and what speaks for it."""

    value: float
    """Grasps below it failed more often."""
    below: tuple[int, int]
    """Successes and grasps below the cuts of the folds that they had no part in."""
    above: tuple[int, int]
    """The same at or above them."""
    p: float
    """Fisher's exact test, one-sided, of those."""

    @property
    def is_significant(self) -> bool:
        """Return whether it is believed."""
        return self.p < MAX_P


def fit_threshold(values: np.ndarray, success: np.ndarray, poses: np.ndarray) -> Threshold | None:
    """Return the cut that parts failures best from successes; None where none leaves `MIN_GRASPS_PER_SIDE` grasps on both sides.

    Args:
        values: (N,) of each grasp; NaN ones are left out.
        success: (N,) bool.
        poses: (N,) the scenarios without their seeds, by which it is cross-validated.
    """
    known = np.isfinite(values)
    values, success, poses = values[known], success[known], poses[known]
    value = _best_cut(values, success)
    if value is None:
        return None
    tally = np.zeros((2, 2), dtype=int)  # below, above; failed, worked
    for train, test in make_folds(poses):
        cut = _best_cut(values[train], success[train])
        if cut is not None:
            np.add.at(tally, ((values[test] >= cut).astype(int), success[test].astype(int)), 1)
    return Threshold(
        value=value,
        below=(int(tally[0, 1]), int(tally[0].sum())),
        above=(int(tally[1, 1]), int(tally[1].sum())),
        p=float(fisher_exact(tally, alternative="greater")[1]),  # pyright: ignore[reportArgumentType]
    )


def _best_cut(values: np.ndarray, success: np.ndarray) -> float | None:
    """Return the midpoint between two values that gives the labels the greatest likelihood, failures below."""
    order = np.argsort(values, kind="stable")
    values, labels = values[order], success[order].astype(float)
    n, right = len(values), float(labels.sum())
    below = np.arange(1, n)
    right_below = np.cumsum(labels)[:-1]
    allowed = (below >= MIN_GRASPS_PER_SIDE) & (n - below >= MIN_GRASPS_PER_SIDE) & (np.diff(values) > 1e-9)
    allowed &= right_below / below < (right - right_below) / np.maximum(n - below, 1)
    if not allowed.any():
        return None
    fit = _log_likelihood(right_below, below) + _log_likelihood(right - right_below, n - below)
    at = int(np.argmax(np.where(allowed, fit, -np.inf)))
    return float(0.5 * (values[at] + values[at + 1]))


def _log_likelihood(right: np.ndarray, n: np.ndarray) -> np.ndarray:
    rate = np.clip(right / n, 1e-12, 1.0 - 1e-12)
    return right * np.log(rate) + (n - right) * np.log(1.0 - rate)
