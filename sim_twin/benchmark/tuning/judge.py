"""Judges proposals by episodes on seeds that they were not fitted to, against the values that were set by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.results.stats import McNemar, mcnemar
from sim_twin.benchmark.tuning.rows import Reading, outcomes
from sim_twin.benchmark.tuning.variants import said
from z1_runtime.grasping.ranking import Ranking

P_MOST = 0.05
"""Least evidence that moves a value that was set by hand."""
LOST_MOST = 0.02
"""Share of the scenarios that a winner in one reading may lose in the other: one of 81 says nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tally:
    """A proposal against the hand-set values on the same held-out scenarios, in one reading."""

    scenarios: int
    hand: int
    """Successes of the hand-set values."""
    tuned: int
    """Successes of the proposal."""
    test: McNemar
    """First the proposal, second the hand-set values."""

    def plain(self) -> dict[str, float]:
        """Return it as YAML and JSON hold it."""
        return {"scenarios": self.scenarios, "hand_set": self.hand, "tuned": self.tuned, "p": self.test.p}


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """Numbers that might be better, and how they were judged."""

    method: str
    """By which name its episodes are logged."""
    ranking: Ranking
    tallies: Mapping[str, Tally]
    """By reading; empty while it was not judged."""
    wins: bool = False


def judge(held: Sequence[Row], name: str, proposals: Sequence[Proposal], reading: Reading) -> list[Proposal]:
    """Return `proposals` with what the rows `held` say of each.

    Args:
        held: of the held-out seeds.
        name: of the method with the hand-set values.
        proposals: of that method; each has its share of `P_MOST`.
        reading: in which a proposal must win; in the other it may lose `LOST_MOST`.
    """
    judged = []
    for proposal in proposals:
        tallies = {each: _tally(held, proposal.method, name, each) for each in get_args(Reading)}
        tallies = {each: tally for each, tally in tallies.items() if tally.scenarios}
        wins = bool(tallies) and _wins(tallies, reading, P_MOST / len(proposals))
        judged.append(replace(proposal, tallies=tallies, wins=wins))
    return judged


def best_of(proposals: Sequence[Proposal], reading: Reading) -> Proposal | None:
    """Return the winner with the most successes; of equals the first, which changes least."""
    winners = [proposal for proposal in proposals if proposal.wins]
    return max(winners, key=lambda proposal: proposal.tallies[reading].tuned, default=None)


def _tally(held: Sequence[Row], method: str, hand: str, reading: Reading) -> Tally:
    by_method = outcomes(held, reading)
    first, second = by_method.get(method, {}), by_method.get(hand, {})
    shared = [scenario for scenario in first if scenario in second]
    tuned, own = np.array([first[s] for s in shared], bool), np.array([second[s] for s in shared], bool)
    return Tally(scenarios=len(shared), hand=int(own.sum()), tuned=int(tuned.sum()), test=mcnemar(tuned, own))


def _wins(tallies: Mapping[str, Tally], reading: Reading, p_most: float) -> bool:
    own = tallies[reading]
    no_worse = all(tally.tuned >= tally.hand - LOST_MOST * tally.scenarios for tally in tallies.values())
    return own.tuned > own.hand and own.test.p < p_most and no_worse


def verdict(hand: Ranking, proposals: Sequence[Proposal], best: Proposal | None, reading: Reading) -> str:
    """Return what became of them, in a sentence."""
    if best is not None:
        tally = best.tallies[reading]
        return (
            f"took {said(best.ranking)} for {said(hand)}: {tally.tuned} of {tally.scenarios} against {tally.hand} on "
            f"the held-out seeds ({reading}), McNemar p = {tally.test.p:.2g}."
        )
    kept = f"kept the hand-set values ({said(hand)})"
    if not proposals:
        return f"{kept} because nothing was proposed: no variant, threshold or head did better where they were fitted."
    if not any(proposal.tallies for proposal in proposals):
        return f"{kept} because no proposal was run on the held-out seeds."
    limit = P_MOST / len(proposals)
    parts = [_lost(proposal, reading, limit) for proposal in proposals if proposal.tallies]
    return f"{kept} because on the held-out seeds {'; '.join(parts)}."


def _lost(proposal: Proposal, reading: Reading, limit: float) -> str:
    tally = proposal.tallies[reading]
    words = f"{said(proposal.ranking)} had {tally.tuned} of {tally.scenarios} ({reading}) against {tally.hand}"
    if tally.tuned <= tally.hand:
        return words
    words += f", McNemar p = {tally.test.p:.2g}"
    if tally.test.p >= limit:
        return f"{words} where below {limit:.2g} was asked for"
    (other,) = (each for each in proposal.tallies if each != reading)
    return f"{words}, but {proposal.tallies[other].tuned} against {proposal.tallies[other].hand} ({other})"
