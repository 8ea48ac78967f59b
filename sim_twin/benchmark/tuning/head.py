"""Fits the scoring head, a logistic regression, and says what it knows of scenarios and objects it has not seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sim_twin.benchmark.tuning.folds import folds_of
from sim_twin.benchmark.tuning.rows import Samples
from z1_runtime.grasping.features import FEATURES
from z1_runtime.grasping.ranking import ScoringHead

PENALTIES = (0.01, 0.1, 1.0, 10.0)
"""Inverse strengths of the L2 penalty, of which cross-validation takes one."""
LEAST = 10
"""Fewest grasps that worked, and that did not."""
_BINS = 8
_CONSTANT = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Skill:
    """How well probabilities tell what works; of grasps that they were not fitted to."""

    grasps: int
    worked: int
    auc: float
    """Chance that one that worked was told more likely than one that did not; NaN where all ended alike."""
    log_loss: float
    log_loss_of_rate: float
    """The same of whoever knows only the share that worked of the grasps fitted to."""
    brier: float


@dataclass(frozen=True, slots=True, kw_only=True)
class HeadReport:
    """A head and what it is worth."""

    head: ScoringHead
    """Fitted to all grasps."""
    skill: Skill
    """Cross-validated by scenario."""
    objects: Mapping[str, Skill]
    """By object, fitted to the others alone."""
    alone: Mapping[str, float]
    """The AUC of single features, for comparison."""
    bins: tuple[tuple[float, int, int], ...]
    """Calibration, cross-validated: mean probability, grasps that worked, grasps; from the least likely up."""

    @property
    def helps(self) -> bool:
        """Return whether it says more than the mere share of successes."""
        return self.skill.log_loss < self.skill.log_loss_of_rate


def fit_head(samples: Samples) -> HeadReport | None:
    """Return the head fitted to `samples`; None where there are too few successes, failures or scenarios."""
    worked = int(samples.worked.sum())
    if min(worked, len(samples) - worked) < LEAST or len(set(samples.poses)) < 2:
        return None
    told = [(test, *_told(samples[train], samples[test])) for train, test in folds_of(samples.poses)]
    order = np.concatenate([test for test, _, _ in told])
    likely, rate = (np.concatenate([each[n] for each in told]) for n in (1, 2))
    judged = samples[order]
    objects = {}
    for name in dict.fromkeys(samples.objects):
        other, own = samples[samples.objects != name], samples[samples.objects == name]
        if len(other):
            objects[str(name)] = _skill(own.worked, *_told(other, own))
    alone = {name: _auc(samples.worked, samples.measured[:, n]) for n, name in enumerate(FEATURES)}
    return HeadReport(
        head=_fitted(samples),
        skill=_skill(judged.worked, likely, rate),
        objects=objects,
        alone=alone,
        bins=_bins(judged.worked, likely),
    )


def _told(train: Samples, test: Samples) -> tuple[np.ndarray, np.ndarray]:
    """Return what a head fitted to `train` says of `test`, (N,), and the share that worked in `train`, (N,)."""
    rate = np.full(len(test), np.clip(train.worked.mean(), 1e-3, 1.0 - 1e-3))
    return (rate if train.worked.all() or not train.worked.any() else _fitted(train).probability(test.measured)), rate


def _fitted(samples: Samples) -> ScoringHead:
    """Return the head with the penalty that cross-validation by scenario likes best."""
    losses = dict.fromkeys(PENALTIES, 0.0)
    for train, test in folds_of(samples.poses):
        part = samples[train]
        if part.worked.all() or not part.worked.any():
            continue
        for penalty in PENALTIES:
            likely = _regression(part, penalty).probability(samples.measured[test])
            losses[penalty] += _loss(samples.worked[test], likely) * len(test)
    return _regression(samples, min(PENALTIES, key=lambda penalty: losses[penalty]))


def _regression(samples: Samples, penalty: float) -> ScoringHead:
    from sklearn.linear_model import LogisticRegression

    mean, scale = samples.measured.mean(axis=0), samples.measured.std(axis=0)
    varies = np.flatnonzero(scale > _CONSTANT)
    model = LogisticRegression(C=penalty, max_iter=2000)
    model.fit((samples.measured[:, varies] - mean[varies]) / scale[varies], samples.worked)
    return ScoringHead(
        features=tuple(np.array(list(FEATURES))[varies].tolist()),
        mean=tuple(mean[varies].tolist()),
        scale=tuple(scale[varies].tolist()),
        coefficients=tuple(model.coef_[0].tolist()),
        intercept=float(np.ravel(model.intercept_)[0]),
    )


def _skill(worked: np.ndarray, likely: np.ndarray, rate: np.ndarray) -> Skill:
    return Skill(
        grasps=len(worked),
        worked=int(worked.sum()),
        auc=_auc(worked, likely),
        log_loss=_loss(worked, likely),
        log_loss_of_rate=_loss(worked, rate),
        brier=float(np.mean((likely - worked) ** 2)),
    )


def _auc(worked: np.ndarray, values: np.ndarray) -> float:
    from sklearn.metrics import roc_auc_score

    return float(roc_auc_score(worked, values)) if 0 < worked.sum() < len(worked) else float("nan")


def _loss(worked: np.ndarray, likely: np.ndarray) -> float:
    from sklearn.metrics import log_loss

    return float(log_loss(worked, likely, labels=[False, True]))


def _bins(worked: np.ndarray, likely: np.ndarray) -> tuple[tuple[float, int, int], ...]:
    parts = [part for part in np.array_split(np.argsort(likely, kind="stable"), _BINS) if len(part)]
    return tuple((float(likely[part].mean()), int(worked[part].sum()), len(part)) for part in parts)
