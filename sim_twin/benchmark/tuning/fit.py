"""Offline calibration of a ranking: numbers proposed from logged episodes, kept only if they win.

For `mvb` and for `full` apart, k, α and the box come from the logged variants, since only episodes show the
result of another choice; thresholds and a scoring head come from the features of grasps with a known outcome.

Each proposal is evaluated by episodes on held-out seeds, against the values set by hand, on the same candidates. It
wins if it has more successes under the reading that is tuned for, if McNemar's exact test is significant at 0.05
divided among the proposals of that method, and if it loses at most 2 % under the other reading.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim_twin.benchmark.episodes.methods import Method, parse_method
from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.scenarios import Scenario
from sim_twin.benchmark.tuning.evaluation import Proposal, describe_verdict, evaluate_proposals, select_best
from sim_twin.benchmark.tuning.head import HeadReport, fit_head
from sim_twin.benchmark.tuning.logged_episodes import Logs, Reading, TuneError, extract_samples, scenario_pose
from sim_twin.benchmark.tuning.proposals import FAMILIES, Draft, baseline_ranking, draft
from z1_runtime.grasping.ranking import Ranking, Scoring

RunEpisodes = Callable[[Sequence[Method], Sequence[Scenario], set[tuple[str, str]]], list[Row]]
"""Run methods in scenarios, without the (scenario, method) pairs of the third argument; return the new rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """Result of the tuning for one method."""

    draft: Draft
    """Fitted to the training rows."""
    proposals: tuple[Proposal, ...]
    """The draft's, with their results on the held-out seeds."""
    kept: Ranking
    tuned: bool
    """Whether `kept` is a proposal."""
    why: str
    """The verdict in a sentence."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tuning:
    """Result of the tuning."""

    reading: Reading
    train_seeds: tuple[int, ...]
    held_out_seeds: tuple[int, ...]
    families: Mapping[str, Family]
    head: HeadReport | None
    head_note: str
    """Reason for no head, or the number of grasps it was fitted to."""
    scoring: Scoring


def tune(
    logs: Logs, *, held_out_seeds: Sequence[int], reading: Reading, folder: Path, run: RunEpisodes | None, head: bool
) -> Tuning:
    """Fit to the rows of all other seeds, evaluate on `held_out_seeds`, and return the result.

    Args:
        logs: of `./z1 bench`; the held-out seeds may be among them.
        held_out_seeds: for the evaluation of proposals.
        reading: in which successes are counted.
        folder: for the proposals that equal no logged method, as scoring files.
        run: runs the missing episodes on the held-out seeds; None leaves such proposals without results.
        head: whether a scoring head is proposed.

    Raises:
        TuneError: no seed is left to fit to, or no method that can be tuned.
    """
    train = [row for row in logs.rows if row["seed"] not in held_out_seeds]
    if not train:
        raise TuneError(
            f"tune: all seeds of the episodes are held out ({', '.join(map(str, logs.seeds))}). Hold out fewer, or log "
            "more.",
            code="all_held_out",
        )
    samples = extract_samples(train, reading)
    report = fit_head(samples) if head else None
    proposed = report.head if report is not None and report.beats_base_rate else None
    drafts = {
        name: draft(name, train, logs.config, reading=reading, head=proposed, folder=folder)
        for name in FAMILIES
        if any(row["method"] == name for row in train)
    }
    if not drafts:
        raise TuneError(
            f"tune: the rows have no episodes of {' or '.join(FAMILIES)} with the hand-set values. Log one of them.",
            code="no_baseline",
        )
    held = _collect_held_out(drafts, train, logs, held_out_seeds, run)
    families = {name: _evaluate(name, drafted, held, reading) for name, drafted in drafts.items()}
    train_seeds = tuple(sorted({row["seed"] for row in train}))
    kept = {name: baseline_ranking(name, logs.config) for name in FAMILIES}
    kept |= {name: family.kept for name, family in families.items()}
    return Tuning(
        reading=reading,
        train_seeds=train_seeds,
        held_out_seeds=tuple(held_out_seeds),
        families=families,
        head=report,
        head_note=_head_note(head, report, samples.success),
        scoring=Scoring(
            mvb=kept["mvb"],
            full=kept["full"],
            tuned=tuple(name for name, family in families.items() if family.tuned),
            evidence=_evidence(families, logs, reading, train_seeds, held_out_seeds),
        ),
    )


def _collect_held_out(
    drafts: Mapping[str, Draft], train: Sequence[Row], logs: Logs, seeds: Sequence[int], run: RunEpisodes | None
) -> list[Row]:
    """Return the rows of the held-out seeds, with those run for it."""
    held = [row for row in logs.rows if row["seed"] in seeds]
    names = [
        text
        for name, drafted in drafts.items()
        if drafted.proposals
        for text in (name, *(proposal.method for proposal in drafted.proposals))
    ]
    if run is None or not names:
        return held
    poses = {scenario_pose(row): row for row in train}
    try:
        scenarios = [replace(Scenario.from_row(row), seed=seed) for seed in seeds for row in poses.values()]
    except ValueError as error:
        raise TuneError(
            f"tune: episodes with a mesh of yours cannot be run again from their rows ({error}) Log the held-out seeds "
            "too, and give --no-run.",
            code="mesh_episodes",
        ) from error
    done = {(row["scenario"], row["method"]) for row in held}
    return [*held, *run([parse_method(text) for text in names], scenarios, done)]


def _evaluate(name: str, drafted: Draft, held: Sequence[Row], reading: Reading) -> Family:
    proposals = evaluate_proposals(held, name, drafted.proposals, reading)
    best = select_best(proposals, reading)
    return Family(
        draft=drafted,
        proposals=tuple(proposals),
        kept=best.ranking if best else drafted.baseline,
        tuned=best is not None,
        why=describe_verdict(drafted.baseline, proposals, best, reading),
    )


def _head_note(wanted: bool, report: HeadReport | None, success: np.ndarray) -> str:
    grasps = f"{len(success)} different grasps with features, {int(success.sum())} of them successful"
    if not wanted:
        return "No head was requested."
    if report is None:
        return (
            f"No head was fitted: the rows have {grasps}; 10 of either kind are needed. Rows of older versions have "
            "none."
        )
    return f"Fitted to {grasps}." + (
        "" if report.beats_base_rate else " It predicts no better than the success rate, so it is not proposed."
    )


def _evidence(
    families: Mapping[str, Family],
    logs: Logs,
    reading: Reading,
    train_seeds: Sequence[int],
    held_out_seeds: Sequence[int],
) -> dict[str, Any]:
    return {
        "version": logs.rows[0]["version"],
        "rows": list(logs.sources),
        "generator": logs.config.generator,
        "detector": logs.config.detector,
        "reading": reading,
        "fitted_to_seeds": list(train_seeds),
        "evaluated_on_seeds": list(held_out_seeds),
        "verdicts": {name: family.why for name, family in families.items()},
        "evaluated": {
            name: [
                {"method": proposal.method, **{key: result.to_dict() for key, result in proposal.results.items()}}
                for proposal in family.proposals
            ]
            for name, family in families.items()
        },
    }
