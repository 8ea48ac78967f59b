"""Proposals for a ranking: the best logged variant, with significant thresholds, without and with a head."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from sim_twin.benchmark.episodes.methods import METHODS
from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.tuning.evaluation import Proposal
from sim_twin.benchmark.tuning.logged_episodes import Reading, collect_outcomes, labelled_grasps, scenario_pose
from sim_twin.benchmark.tuning.thresholds import Threshold, fit_threshold
from sim_twin.benchmark.tuning.variants import Variants, find_variants, select_variant
from z1_runtime.config import RuntimeConfig, hand_set
from z1_runtime.grasping.ranking import Ranking, Scoring, ScoringHead, save_scoring

FAMILIES = ("mvb", "full")
"""Methods whose numbers are tuned."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Draft:
    """Numbers fitted to the training rows for one method."""

    baseline: Ranking
    """Set by hand."""
    variants: Variants
    rankings: Mapping[str, Ranking]
    """Of the variants, by name."""
    thresholds: Mapping[str, Threshold | None]
    """By their name in `Ranking`."""
    proposals: tuple[Proposal, ...]
    """At most two: without a head, and with it."""


def baseline_ranking(name: str, config: RuntimeConfig) -> Ranking:
    """Return the numbers set by hand that the method `name` ranks by."""
    return METHODS[name].ranking(hand_set(config))


def draft(
    name: str,
    train: Sequence[Row],
    config: RuntimeConfig,
    *,
    reading: Reading,
    head: ScoringHead | None,
    folder: Path,
) -> Draft:
    """Return the draft for the method `name`.

    Args:
        name: one of `FAMILIES`, with episodes under its hand-set values.
        train: rows of all methods.
        config: the settings of their run.
        reading: in which successes are counted.
        head: proposed in addition to the rest.
        folder: for the proposals that equal no logged method, as scoring files.
    """
    baseline = baseline_ranking(name, config)
    by_reading = {each: collect_outcomes(train, each) for each in get_args(Reading)}
    methods = find_variants(name, list(by_reading[reading]))
    rankings = {text: method.ranking(baseline) for text, method in methods.items()}
    variants = select_variant(by_reading, reading, list(methods), name)
    thresholds = _fit_thresholds(rankings, rankings[variants.chosen], train, reading)
    held = {key: threshold.value for key, threshold in thresholds.items() if threshold and threshold.is_significant}
    plain = replace(rankings[variants.chosen], **held)
    proposed = [plain] if head is None else [plain, replace(plain, head=head)]
    logged = {ranking: text for text, ranking in rankings.items()}
    proposals = tuple(
        Proposal(
            ranking=ranking, method=logged.get(ranking) or _save_proposal(name, ranking, config, folder), results={}
        )
        for ranking in proposed
        if ranking != baseline
    )
    return Draft(baseline=baseline, variants=variants, rankings=rankings, thresholds=thresholds, proposals=proposals)


def _save_proposal(name: str, ranking: Ranking, config: RuntimeConfig, folder: Path) -> str:
    """Write `ranking` as a scoring file of its own, named by its content; return the method that ranks by it."""
    both = {family: baseline_ranking(family, config) for family in FAMILIES} | {name: ranking}
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}-{hashlib.sha256(repr(ranking).encode()).hexdigest()[:12]}.yaml"
    save_scoring(Scoring(mvb=both["mvb"], full=both["full"], tuned=(name,), evidence={"proposal": True}), path)
    return f"{name}:scoring={path}"


def _fit_thresholds(
    rankings: Mapping[str, Ranking], best: Ranking, train: Sequence[Row], reading: Reading
) -> dict[str, Threshold | None]:
    """Return the thresholds of the alignment and of the generator's score, from the method's own grasps.

    An alignment depends on the box and on k, so variants that differ from `best` in those are left out.
    """
    comparable = {
        text
        for text, ranking in rankings.items()
        if (ranking.box_method, ranking.k_faces) == (best.box_method, best.k_faces)
    }
    known = list(labelled_grasps((row for row in train if row["method"] in comparable), reading))
    success = np.array([succeeded for *_, succeeded in known], dtype=bool)
    poses = np.array([scenario_pose(row) for row, *_ in known], dtype=str)
    columns = {
        "min_alignment": {"first": "first_box_alignment", "grasp": "alignment"},
        "min_score": {"first": "first_generator", "grasp": "generator_score"},
    }
    return {
        key: fit_threshold(np.array([row[column[which]] for row, which, _ in known], dtype=float), success, poses)
        for key, column in columns.items()
    }
