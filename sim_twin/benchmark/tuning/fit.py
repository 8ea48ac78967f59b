"""Offline calibration: proposes the numbers of a ranking from logged episodes, and keeps them only if they win.

For `mvb` and for `full` apart, k, α and the box come from the variants that were logged, since only episodes say what
another choice leads to; thresholds and a scoring head come from what was features of the grasps whose outcome is known.

What is proposed so is evaluated by episodes on seeds that it was not fitted to, against the values set by baseline, on the
very same candidates. A proposal wins if it has more successes under the reading that is tuned for, if McNemar's exact
test says so at 0.05 shared among the proposals of that method, and if it has no fewer under the other reading.
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
"""Runs methods in scenarios, but not the (scenario, method) pairs of the third argument; returns the new rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """What tuning came to for one method."""

    draft: Draft
    """What was fitted."""
    proposals: tuple[Proposal, ...]
    """The draft's, judged."""
    kept: Ranking
    tuned: bool
    """Whether `kept` is a proposal."""
    why: str
    """The verdict in a sentence."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tuning:
    """All that tuning found."""

    reading: Reading
    train_seeds: tuple[int, ...]
    held_out_seeds: tuple[int, ...]
    families: Mapping[str, Family]
    head: HeadReport | None
    head_note: str
    """Why there is no head, or what it was fitted to."""
    scoring: Scoring


def tune(
    logs: Logs, *, held_out_seeds: Sequence[int], reading: Reading, folder: Path, run: RunEpisodes | None, head: bool
) -> Tuning:
    """Return what the rows of all other seeds teach, judged on `held_out_seeds`.

    Args:
        logs: of `./z1 bench`; the held-out seeds may be among them.
        held_out_seeds: by which proposals are evaluated.
        reading: in which successes are counted.
        folder: for the proposals that no logged method stands for, as scoring files.
        run: runs what is missing on the held-out seeds; None leaves such proposals unjudged.
        head: whether a scoring head is proposed.

    Raises:
        TuneError: no seed is left to fit to, or no method that can be tuned.
    """
    train = [row for row in logs.rows if row["seed"] not in held_out_seeds]
    if not train:
        raise TuneError(
            f"all seeds of the episodes ({', '.join(map(str, logs.seeds))}) are held out; name fewer, or log more."
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
        raise TuneError(f"no episodes of {' or '.join(FAMILIES)} with the hand-set values are among the rows.")
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
    """Return the rows of the held-out seeds, those that had to be run for it among them."""
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
            f"{error} Episodes with a mesh of yours cannot be run again from their rows: log the held-out seeds too, "
            "and give --no-run."
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
    seen = f"{len(success)} different grasps with features, {int(success.sum())} of which worked"
    if not wanted:
        return "No head was asked for."
    if report is None:
        return (
            f"No head was fitted: the rows hold {seen}; it takes 10 of either kind. Rows of an older version hold none."
        )
    return f"Fitted to {seen}." + (
        "" if report.beats_base_rate else " It says no more than their share, so it is not proposed."
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
        "judged_on_seeds": list(held_out_seeds),
        "verdicts": {name: family.why for name, family in families.items()},
        "evaluated": {
            name: [
                {"method": proposal.method, **{key: tally.plain() for key, tally in proposal.results.items()}}
                for proposal in family.proposals
            ]
            for name, family in families.items()
        },
    }
