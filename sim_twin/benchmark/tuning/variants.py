"""Choice among variants of a method run on the same candidates, with its cross-validated worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sim_twin.benchmark.episodes.methods import Method, parse_method
from sim_twin.benchmark.tuning.folds import make_folds
from sim_twin.benchmark.tuning.logged_episodes import Outcomes, Reading
from z1_runtime.grasping.ranking import Ranking


@dataclass(frozen=True, slots=True, kw_only=True)
class Variants:
    """Comparison of the variants of one method."""

    names: tuple[str, ...]
    """All variants compared, the hand-set one first."""
    successes: Mapping[str, Mapping[str, int]]
    """By reading and variant, on all training scenarios."""
    scenarios: int
    """Training scenarios common to all of them."""
    chosen: str
    """The best on all of them."""
    by_fold: tuple[str, ...]
    """The best on each fold's training part."""
    cross_validated: int
    """Successes of these on the other part of each fold: the worth of this choice on new scenarios."""


def find_variants(family: str, names: Sequence[str]) -> dict[str, Method]:
    """Return those of `names` that are variants of `family` and that a scoring can express, the hand-set one first.

    Raises:
        ScoringError: a variant's scoring file is missing.
    """
    own = [name for name in names if name.partition(":")[0] == family]
    methods = {name: parse_method(name) for name in sorted(own, key=lambda name: (name != family, name))}
    return {name: method for name, method in methods.items() if method.collision_filter}


def select_variant(
    by_reading: Mapping[str, Outcomes], reading: Reading, names: Sequence[str], baseline: str
) -> Variants:
    """Return the variant with the most successes; of equals the one set by hand, or else the first.

    Args:
        by_reading: outcomes of all variants, on the training scenarios.
        reading: in which they are compared.
        names: the variants, with `baseline` among them.
        baseline: the one whose numbers are set by hand.
    """
    outcomes = by_reading[reading]
    shared = sorted(set.intersection(*(set(outcomes[name]) for name in names)))
    poses = [scenario.rpartition("-s")[0] for scenario in shared]
    # `max` returns the first of equals, here the hand-set one
    names = [baseline, *(name for name in names if name != baseline)]

    def best(scenarios: Sequence[str]) -> str:
        return max(names, key=lambda name: sum(outcomes[name][scenario] for scenario in scenarios))

    by_fold, successes = [], 0
    for train, test in make_folds(poses):
        by_fold.append(best([shared[n] for n in train]))
        successes += sum(outcomes[by_fold[-1]][shared[n]] for n in test)
    return Variants(
        names=tuple(names),
        successes={
            each: {name: sum(own[name][scenario] for scenario in shared) for name in names}
            for each, own in by_reading.items()
        },
        scenarios=len(shared),
        chosen=best(shared),
        by_fold=tuple(by_fold),
        cross_validated=successes,
    )


def format_ranking(ranking: Ranking) -> str:
    """Return the numbers of `ranking` in one line."""
    words = f"k={ranking.k_faces} α={ranking.alpha:g} box={ranking.box_method}"
    words += "" if ranking.hard_filter else " no hard filter"
    words += f" a≥{ranking.min_alignment:.3g}" if ranking.min_alignment > -1.0 else ""
    words += f" s≥{ranking.min_score:.3g}" if ranking.min_score > 0.0 else ""
    return words + (" + head" if ranking.head else "")
