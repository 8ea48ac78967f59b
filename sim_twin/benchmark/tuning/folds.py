"""Folds of the scenarios for cross-validation, and the check for scikit-learn."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hal.base.errors import Z1Error

FOLDS = 5


class NoSklearnError(Z1Error, RuntimeError):
    """The package scikit-learn is not installed."""

    default_code = "sklearn_missing"


def require_sklearn() -> None:
    """Raise unless scikit-learn can be imported.

    Raises:
        NoSklearnError: it is not installed.
    """
    try:
        import sklearn  # noqa: F401
    except ImportError as error:
        raise NoSklearnError(
            "tune: scikit-learn is not installed (extra `tune`). Run uv sync --inexact --extra tune, then this again."
        ) from error


def make_folds(groups: Sequence[str] | np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield indices to fit on and to evaluate on, 5 times or once for each group if there are fewer.

    No group is on both sides: the same pose under two seeds is nearly the same scenario. One group alone yields
    nothing.
    """
    from sklearn.model_selection import GroupKFold

    n = min(FOLDS, len(set(groups)))
    if n >= 2:
        yield from GroupKFold(n, shuffle=True, random_state=0).split(np.zeros(len(groups)), groups=groups)
