"""Evaluation of proposals on held-out seeds, against the values set by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.results.stats import McNemar, mcnemar
from sim_twin.benchmark.tuning.logged_episodes import Reading, collect_outcomes
from sim_twin.benchmark.tuning.variants import format_ranking
from z1_runtime.grasping.ranking import Ranking

MAX_P = 0.05
"""Significance level at which a proposal replaces a value set by hand."""
MAX_LOST_RATIO = 0.02
"""Ratio of the scenarios that a winner in one reading may lose in the other: one of 81 is no evidence."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutResult:
    """A proposal against the hand-set values on the same held-out scenarios, in one reading."""

    scenarios: int
    baseline: int
    """Successes of the hand-set values."""
    tuned: int
    """Successes of the proposal."""
    test: McNemar
    """First the proposal, second the hand-set values."""

    def to_dict(self) -> dict[str, float]:
        """Return the counts and p for YAML and JSON."""
        return {"scenarios": self.scenarios, "hand_set": self.baseline, "tuned": self.tuned, "p": self.test.p}


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """Proposed numbers of a ranking, and their results on the held-out seeds."""

    method: str
    """Name under which its episodes are logged."""
    ranking: Ranking
    results: Mapping[str, HeldOutResult]
    """By reading; empty before the evaluation."""
    wins: bool = False


def evaluate_proposals(
    held: Sequence[Row], name: str, proposals: Sequence[Proposal], reading: Reading
) -> list[Proposal]:
    """Return `proposals` with their results in the rows `held`.

    Args:
        held: of the held-out seeds.
        name: of the method with the hand-set values.
        proposals: of that method; `MAX_P` is divided among them (Bonferroni).
        reading: in which a proposal must win; in the other it may lose `MAX_LOST_RATIO`.
    """
    evaluated = []
    for proposal in proposals:
        results = {each: _compare(held, proposal.method, name, each) for each in get_args(Reading)}
        results = {each: result for each, result in results.items() if result.scenarios}
        wins = bool(results) and _wins(results, reading, MAX_P / len(proposals))
        evaluated.append(replace(proposal, results=results, wins=wins))
    return evaluated


def select_best(proposals: Sequence[Proposal], reading: Reading) -> Proposal | None:
    """Return the winner with the most successes; of equals the first, which changes least."""
    winners = [proposal for proposal in proposals if proposal.wins]
    return max(winners, key=lambda proposal: proposal.results[reading].tuned, default=None)


def _compare(held: Sequence[Row], method: str, baseline: str, reading: Reading) -> HeldOutResult:
    by_method = collect_outcomes(held, reading)
    first, second = by_method.get(method, {}), by_method.get(baseline, {})
    shared = [scenario for scenario in first if scenario in second]
    tuned, own = np.array([first[s] for s in shared], bool), np.array([second[s] for s in shared], bool)
    return HeldOutResult(
        scenarios=len(shared), baseline=int(own.sum()), tuned=int(tuned.sum()), test=mcnemar(tuned, own)
    )


def _wins(results: Mapping[str, HeldOutResult], reading: Reading, max_p: float) -> bool:
    own = results[reading]
    no_worse = all(result.tuned >= result.baseline - MAX_LOST_RATIO * result.scenarios for result in results.values())
    return own.tuned > own.baseline and own.test.p < max_p and no_worse


def describe_verdict(baseline: Ranking, proposals: Sequence[Proposal], best: Proposal | None, reading: Reading) -> str:
    """Return the decision and its reason in a sentence."""
    if best is not None:
        result = best.results[reading]
        return (
            f"took {format_ranking(best.ranking)} for {format_ranking(baseline)}: {result.tuned} of "
            f"{result.scenarios} against {result.baseline} on the held-out seeds ({reading}), "
            f"McNemar p = {result.test.p:.2g}."
        )
    kept = f"kept the hand-set values ({format_ranking(baseline)})"
    if not proposals:
        return f"{kept} because nothing was proposed: no variant, threshold or head did better where they were fitted."
    if not any(proposal.results for proposal in proposals):
        return f"{kept} because no proposal was run on the held-out seeds."
    limit = MAX_P / len(proposals)
    parts = [_describe_loss(proposal, reading, limit) for proposal in proposals if proposal.results]
    return f"{kept} because on the held-out seeds {'; '.join(parts)}."


def _describe_loss(proposal: Proposal, reading: Reading, limit: float) -> str:
    result = proposal.results[reading]
    words = f"{format_ranking(proposal.ranking)} had {result.tuned} of {result.scenarios} ({reading})"
    words += f" against {result.baseline}"
    if result.tuned <= result.baseline:
        return words
    words += f", McNemar p = {result.test.p:.2g}"
    if result.test.p >= limit:
        return f"{words} where below {limit:.2g} was required"
    (other,) = (each for each in proposal.results if each != reading)
    return f"{words}, but {proposal.results[other].tuned} against {proposal.results[other].baseline} ({other})"
