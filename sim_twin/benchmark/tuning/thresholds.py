"""Looks for a value below which grasps fail: one cut of one number, believed only if it holds out of its own fold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import fisher_exact

from sim_twin.benchmark.tuning.folds import folds_of

LEAST = 5
"""Fewest grasps below a cut."""
P_MOST = 0.05


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
    def holds(self) -> bool:
        """Return whether it is believed."""
        return self.p < P_MOST


def fit_threshold(values: np.ndarray, worked: np.ndarray, poses: np.ndarray) -> Threshold | None:
    """Return the cut that parts failures best from successes; None where none leaves `LEAST` grasps on both sides.

    Args:
        values: (N,) of each grasp; NaN ones are left out.
        worked: (N,) bool.
        poses: (N,) the scenarios without their seeds, by which it is cross-validated.
    """
    known = np.isfinite(values)
    values, worked, poses = values[known], worked[known], poses[known]
    value = _best_cut(values, worked)
    if value is None:
        return None
    tally = np.zeros((2, 2), dtype=int)  # below, above; failed, worked
    for train, test in folds_of(poses):
        cut = _best_cut(values[train], worked[train])
        if cut is not None:
            np.add.at(tally, ((values[test] >= cut).astype(int), worked[test].astype(int)), 1)
    return Threshold(
        value=value,
        below=(int(tally[0, 1]), int(tally[0].sum())),
        above=(int(tally[1, 1]), int(tally[1].sum())),
        p=float(fisher_exact(tally, alternative="greater")[1]),  # pyright: ignore[reportArgumentType]
    )


def _best_cut(values: np.ndarray, worked: np.ndarray) -> float | None:
    """Return the midpoint between two values that gives the labels the greatest likelihood, failures below."""
    order = np.argsort(values, kind="stable")
    values, labels = values[order], worked[order].astype(float)
    n, right = len(values), float(labels.sum())
    below = np.arange(1, n)
    right_below = np.cumsum(labels)[:-1]
    allowed = (below >= LEAST) & (n - below >= LEAST) & (np.diff(values) > 1e-9)
    allowed &= right_below / below < (right - right_below) / np.maximum(n - below, 1)
    if not allowed.any():
        return None
    fit = _log_likelihood(right_below, below) + _log_likelihood(right - right_below, n - below)
    at = int(np.argmax(np.where(allowed, fit, -np.inf)))
    return float(0.5 * (values[at] + values[at + 1]))


def _log_likelihood(right: np.ndarray, n: np.ndarray) -> np.ndarray:
    rate = np.clip(right / n, 1e-12, 1.0 - 1e-12)
    return right * np.log(rate) + (n - right) * np.log(1.0 - rate)
