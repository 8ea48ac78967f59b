"""Uncertainty radius of an estimated position or rotation."""

from __future__ import annotations

import numpy as np
from scipy.stats import f as f_distribution

COVERAGE = 0.99
"""Ratio of calibrations whose true error is below the reported uncertainty."""


def compute_uncertainty(covariance: np.ndarray, n_samples: int) -> float:
    """Return the radius within which an error (3,) of `covariance` (3, 3) is with probability `COVERAGE`.

    The squared error is a weighted sum of chi squares, approximated after Satterthwaite (1946) by one scaled chi square
    of h degrees of freedom. The covariance itself is estimated from `n_samples` samples, of which the two poses take
    two: the distribution becomes F.
    """
    variances = np.linalg.eigvalsh(covariance).clip(0.0)
    total = variances.sum()
    if total == 0.0:
        return 0.0
    h = total**2 / (variances**2).sum()
    return float(np.sqrt(total * f_distribution.ppf(COVERAGE, h, max(n_samples - 2, 1))))
