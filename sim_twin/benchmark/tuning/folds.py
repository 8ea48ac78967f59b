"""How scenarios are cut for cross-validation, and the word for who lacks scikit-learn."""

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
        NoSklearnError: it cannot.
    """
    try:
        import sklearn  # noqa: F401
    except ImportError as error:
        raise NoSklearnError(
            "tuning needs scikit-learn, which is an extra: uv sync --inexact --extra tune, then run this again."
        ) from error


def make_folds(groups: Sequence[str] | np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield indices to fit on and to judge on, 5 times or once for each group if there are fewer.

    No group stands on both sides: the same pose under two seeds is nearly the same scenario. Two at least are needed;
    with one nothing is yielded.
    """
    from sklearn.model_selection import GroupKFold

    n = min(FOLDS, len(set(groups)))
    if n >= 2:
        yield from GroupKFold(n, shuffle=True, random_state=0).split(np.zeros(len(groups)), groups=groups)
