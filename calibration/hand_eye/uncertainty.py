"""From a covariance to one number an operator can read."""

from __future__ import annotations

import numpy as np
from scipy.stats import f as f_distribution

COVERAGE = 0.99
"""Share of calibrations whose true error is below the reported uncertainty."""


def radius(covariance: np.ndarray, n_samples: int) -> float:
    """Return the length that the error (3,) of `covariance` (3, 3) stays below with probability `COVERAGE`.

    The squared length is a sum of squares of unequal weight; after Satterthwaite it is taken as one scaled chi square
    of h degrees of freedom. The covariance was estimated from `n_samples` samples, two of which the two poses use up:
    that makes F of it.
    """
    sizes = np.linalg.eigvalsh(covariance).clip(0.0)
    total = sizes.sum()
    if total == 0.0:
        return 0.0
    h = total**2 / (sizes**2).sum()
    return float(np.sqrt(total * f_distribution.ppf(COVERAGE, h, max(n_samples - 2, 1))))
