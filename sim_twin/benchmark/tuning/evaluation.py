"""Judges proposals by episodes on seeds that they were not fitted to, against the values that were set by hand."""

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
"""Least evidence that moves a value that was set by hand."""
MAX_LOST_RATIO = 0.02
"""Share of the scenarios that a winner in one reading may lose in the other: one of 81 says nothing."""


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

    def plain(self) -> dict[str, float]:
        """Return it as YAML and JSON hold it."""
        return {"scenarios": self.scenarios, "hand_set": self.baseline, "tuned": self.tuned, "p": self.test.p}


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """Numbers that might be better, and how they were judged."""

    method: str
    """By which name its episodes are logged."""
    ranking: Ranking
    results: Mapping[str, HeldOutResult]
    """By reading; empty while it was not judged."""
    wins: bool = False


def evaluate_proposals(
    held: Sequence[Row], name: str, proposals: Sequence[Proposal], reading: Reading
) -> list[Proposal]:
    """Return `proposals` with what the rows `held` say of each.

    Args:
        held: of the held-out seeds.
        name: of the method with the baseline-set values.
        proposals: of that method; each has its share of `MAX_P`.
        reading: in which a proposal must win; in the other it may lose `MAX_LOST_RATIO`.
    """
    evaluated = []
    for proposal in proposals:
        results = {each: _compare(held, proposal.method, name, each) for each in get_args(Reading)}
        results = {each: tally for each, tally in results.items() if tally.scenarios}
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


def _wins(results: Mapping[str, HeldOutResult], reading: Reading, p_most: float) -> bool:
    own = results[reading]
    no_worse = all(tally.tuned >= tally.baseline - MAX_LOST_RATIO * tally.scenarios for tally in results.values())
    return own.tuned > own.baseline and own.test.p < p_most and no_worse


def describe_verdict(baseline: Ranking, proposals: Sequence[Proposal], best: Proposal | None, reading: Reading) -> str:
    """Return what became of them, in a sentence."""
    if best is not None:
        tally = best.results[reading]
        return (
            f"took {format_ranking(best.ranking)} for {format_ranking(baseline)}: {tally.tuned} of {tally.scenarios} against {tally.baseline} on "
            f"the held-out seeds ({reading}), McNemar p = {tally.test.p:.2g}."
        )
    kept = f"kept the hand-set values ({format_ranking(baseline)})"
    if not proposals:
        return f"{kept} because nothing was proposed: no variant, threshold or head did better where they were fitted."
    if not any(proposal.results for proposal in proposals):
        return f"{kept} because no proposal was run on the held-out seeds."
    limit = MAX_P / len(proposals)
    parts = [_lost(proposal, reading, limit) for proposal in proposals if proposal.results]
    return f"{kept} because on the held-out seeds {'; '.join(parts)}."


def _lost(proposal: Proposal, reading: Reading, limit: float) -> str:
    tally = proposal.results[reading]
    words = f"{format_ranking(proposal.ranking)} had {tally.tuned} of {tally.scenarios} ({reading}) against {tally.baseline}"
    if tally.tuned <= tally.baseline:
        return words
    words += f", McNemar p = {tally.test.p:.2g}"
    if tally.test.p >= limit:
        return f"{words} where below {limit:.2g} was asked for"
    (other,) = (each for each in proposal.results if each != reading)
    return f"{words}, but {proposal.results[other].tuned} against {proposal.results[other].baseline} ({other})"
