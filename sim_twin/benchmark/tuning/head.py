"""Fit of the scoring head, a logistic regression, and its metrics on held-out scenarios and objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sim_twin.benchmark.tuning.folds import make_folds
from sim_twin.benchmark.tuning.logged_episodes import Samples
from z1_runtime.grasping.ranking import FEATURES, ScoringHead

PENALTIES = (0.01, 0.1, 1.0, 10.0)
"""Inverse strengths of the L2 penalty that cross-validation chooses from."""
MIN_GRASPS_PER_CLASS = 10
"""Minimum number of successful grasps, and of failed ones."""
_BINS = 8
_CONSTANT = 1e-9  # standard deviation below which a feature carries nothing but rounding


@dataclass(frozen=True, slots=True, kw_only=True)
class Skill:
    """Metrics of predicted probabilities, on grasps that they were not fitted to."""

    grasps: int
    successes: int
    auc: float
    """Chance that a success was predicted more probable than a failure; NaN where all outcomes are the same."""
    log_loss: float
    log_loss_of_base_rate: float
    """The same of predicting the success rate of the grasps fitted to."""
    brier: float


@dataclass(frozen=True, slots=True, kw_only=True)
class HeadReport:
    """A head and its metrics."""

    head: ScoringHead
    """Fitted to all grasps."""
    skill: Skill
    """Cross-validated by scenario."""
    objects: Mapping[str, Skill]
    """By object, fitted to the others alone."""
    single_feature_auc: Mapping[str, float]
    """The AUC of single features, for comparison."""
    bins: tuple[tuple[float, int, int], ...]
    """Calibration, cross-validated: mean probability, successes, grasps; by increasing probability."""

    @property
    def beats_base_rate(self) -> bool:
        """Return whether it predicts better than the success rate alone."""
        return self.skill.log_loss < self.skill.log_loss_of_base_rate


def fit_head(samples: Samples) -> HeadReport | None:
    """Return the head fitted to `samples`; None where there are too few successes, failures or scenarios."""
    successes = int(samples.success.sum())
    if min(successes, len(samples) - successes) < MIN_GRASPS_PER_CLASS or len(set(samples.poses)) < 2:
        return None
    predictions = [(test, *_predict(samples[train], samples[test])) for train, test in make_folds(samples.poses)]
    order = np.concatenate([test for test, _, _ in predictions])
    probabilities, rate = (np.concatenate([each[n] for each in predictions]) for n in (1, 2))
    evaluated = samples[order]
    objects = {}
    for name in dict.fromkeys(samples.objects):
        other, own = samples[samples.objects != name], samples[samples.objects == name]
        if len(other):
            objects[str(name)] = _measure_skill(own.success, *_predict(other, own))
    single_feature_auc = {name: _auc(samples.success, samples.features[:, n]) for n, name in enumerate(FEATURES)}
    return HeadReport(
        head=_fit_regularised(samples),
        skill=_measure_skill(evaluated.success, probabilities, rate),
        objects=objects,
        single_feature_auc=single_feature_auc,
        bins=_bins(evaluated.success, probabilities),
    )


def _predict(train: Samples, test: Samples) -> tuple[np.ndarray, np.ndarray]:
    """Return the probabilities (N,) that a head fitted to `train` predicts for `test`, and the rate of `train` (N,)."""
    rate = np.full(len(test), np.clip(train.success.mean(), 1e-3, 1.0 - 1e-3))  # the log loss of 0 and 1 is infinite
    if train.success.all() or not train.success.any():
        return rate, rate
    return _fit_regularised(train).probability(test.features), rate


def _fit_regularised(samples: Samples) -> ScoringHead:
    """Return the head with the penalty of the lowest loss, cross-validated by scenario."""
    losses = dict.fromkeys(PENALTIES, 0.0)
    for train, test in make_folds(samples.poses):
        part = samples[train]
        if part.success.all() or not part.success.any():
            continue
        for penalty in PENALTIES:
            probabilities = _fit(part, penalty).probability(samples.features[test])
            losses[penalty] += _loss(samples.success[test], probabilities) * len(test)
    return _fit(samples, min(PENALTIES, key=lambda penalty: losses[penalty]))


def _fit(samples: Samples, penalty: float) -> ScoringHead:
    from sklearn.linear_model import LogisticRegression

    # Standardised: the L2 penalty would weigh features by their units
    mean, scale = samples.features.mean(axis=0), samples.features.std(axis=0)
    varies = np.flatnonzero(scale > _CONSTANT)
    model = LogisticRegression(C=penalty, max_iter=2000)
    model.fit((samples.features[:, varies] - mean[varies]) / scale[varies], samples.success)
    return ScoringHead(
        features=tuple(np.array(list(FEATURES))[varies].tolist()),
        mean=tuple(mean[varies].tolist()),
        scale=tuple(scale[varies].tolist()),
        coefficients=tuple(model.coef_[0].tolist()),
        intercept=float(np.ravel(model.intercept_)[0]),
    )


def _measure_skill(success: np.ndarray, probabilities: np.ndarray, rate: np.ndarray) -> Skill:
    return Skill(
        grasps=len(success),
        successes=int(success.sum()),
        auc=_auc(success, probabilities),
        log_loss=_loss(success, probabilities),
        log_loss_of_base_rate=_loss(success, rate),
        brier=float(np.mean((probabilities - success) ** 2)),
    )


def _auc(success: np.ndarray, values: np.ndarray) -> float:
    from sklearn.metrics import roc_auc_score

    return float(roc_auc_score(success, values)) if 0 < success.sum() < len(success) else float("nan")


def _loss(success: np.ndarray, probabilities: np.ndarray) -> float:
    from sklearn.metrics import log_loss

    # A fold may have one outcome only, from which scikit-learn cannot infer the labels
    return float(log_loss(success, probabilities, labels=[False, True]))


def _bins(success: np.ndarray, probabilities: np.ndarray) -> tuple[tuple[float, int, int], ...]:
    parts = [part for part in np.array_split(np.argsort(probabilities, kind="stable"), _BINS) if len(part)]
    return tuple((float(probabilities[part].mean()), int(success[part].sum()), len(part)) for part in parts)
