"""report.html of a tuning run: variants, thresholds, held-out results and the scoring head on one page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sim_twin.benchmark.report.page import write_page
from sim_twin.benchmark.report.plots import Point, method_keys, plot_rate_curves
from sim_twin.benchmark.report.tables import Table
from sim_twin.benchmark.tuning.fit import Family, Tuning
from sim_twin.benchmark.tuning.head import HeadReport, Skill
from sim_twin.benchmark.tuning.thresholds import Threshold
from sim_twin.benchmark.tuning.variants import format_ranking
from z1_runtime.grasping.ranking import FEATURES


def write_tuning_report(tuning: Tuning, path: Path) -> None:
    """Write the report of `tuning`; the file appears once it is complete."""
    write_page(
        path,
        "tuning.html.j2",
        title="Offline calibration of the ranking",
        scope=f"Fitted to seeds {_list(tuning.train_seeds)}, evaluated on seeds {_list(tuning.held_out_seeds)}, by the "
        f"reading {tuning.reading}.",
        families=[_describe_family(name, family, tuning.reading) for name, family in tuning.families.items()],
        head_note=tuning.head_note,
        head=_describe_head(tuning.head) if tuning.head else None,
    )


def tabulate_variants(name: str, family: Family, reading: str) -> Table:
    """Return successes of each variant on the seeds fitted to."""
    draft, variants = family.draft, family.draft.variants
    rows = [
        [
            text,
            format_ranking(draft.rankings[text]),
            *(f"{own[text]} of {variants.scenarios}" for own in variants.successes.values()),
        ]
        for text in variants.names
    ]
    folds = ", ".join(dict.fromkeys(variants.by_fold)) or "none"
    note = (
        f"On the seeds fitted to. Best: {variants.chosen}; best of a part of the scenarios: {folds}. Cross-validated, "
        f"this choice gives {variants.cross_validated} of {variants.scenarios} ({reading}), the hand-set values "
        f"{variants.successes[reading][name]}."
    )
    return Table(["variant", "numbers", *variants.successes], rows, note)


def tabulate_held_out(family: Family) -> Table:
    """Return the proposals' successes on the held-out seeds, by reading, next to the hand-set values'."""
    rows = [
        [
            format_ranking(proposal.ranking),
            reading,
            f"{result.tuned} of {result.scenarios}",
            f"{result.baseline} of {result.scenarios}",
            f"{result.test.p:.2g}",
            "taken" if proposal.ranking == family.kept else "won" if proposal.wins else "not kept",
        ]
        for proposal in family.proposals
        for reading, result in proposal.results.items()
    ]
    return Table(["proposal", "reading", "successes", "set by hand", "McNemar p", ""], rows)


def tabulate_thresholds(thresholds: Mapping[str, Threshold | None]) -> Table:
    """Return each threshold with the successes below and above it outside of its own fold."""
    rows = [_threshold_row(name, threshold) for name, threshold in thresholds.items()]
    return Table(["threshold", "value", "successes below", "successes above", "Fisher p", ""], rows)


def _threshold_row(name: str, threshold: Threshold | None) -> list[str]:
    if threshold is None:
        return [name, "–", "–", "–", "–", "no value with more failures below it"]
    (low, n_low), (high, n_high) = threshold.below, threshold.above
    conclusion = "proposed" if threshold.is_significant else "not significant outside of its own fold"
    counts = [f"{low} of {n_low}", f"{high} of {n_high}"]
    return [name, f"{threshold.value:.4g}", *counts, f"{threshold.p:.2g}", conclusion]


def tabulate_skill(report: HeadReport) -> Table:
    """Return the head's metrics on grasps that it was not fitted to."""
    rows = [_skill_row("other scenarios", report.skill)]
    rows += [_skill_row(f"{name}, fitted to the others", skill) for name, skill in report.objects.items()]
    return Table(["evaluated on", "successes", "AUC", "log loss", "log loss of the success rate alone", "Brier"], rows)


def _skill_row(name: str, skill: Skill) -> list[str]:
    metrics = (skill.auc, skill.log_loss, skill.log_loss_of_base_rate, skill.brier)
    return [name, f"{skill.successes} of {skill.grasps}", *(f"{metric:.3f}" for metric in metrics)]


def _describe_family(name: str, family: Family, reading: str) -> dict[str, Any]:
    curves = _curves(family, reading)
    caption = f"Success ({reading}) on the seeds fitted to, against α; lines are 95 % intervals."
    return {
        "name": name,
        "tuned": family.tuned,
        "verdict": family.why,
        "legend": method_keys(list(curves)),
        "plot": plot_rate_curves(curves, "α", caption),
        "variants": tabulate_variants(name, family, reading),
        "thresholds": tabulate_thresholds(family.draft.thresholds),
        "held_out": tabulate_held_out(family),
    }


def _curves(family: Family, reading: str) -> dict[str, list[Point]]:
    """Return success against α for each k and box; of variants that differ in nothing else."""
    draft = family.draft
    series: dict[str, list[Point]] = {}
    for text in draft.variants.names:
        ranking = draft.rankings[text]
        if ranking.head is None and (ranking.min_alignment, ranking.min_score) == (
            draft.baseline.min_alignment,
            draft.baseline.min_score,
        ):
            rest = "" if ranking.hard_filter else ", no hard filter"
            name = f"k = {ranking.k_faces}, {ranking.box_method}{rest}"
            counts = draft.variants.successes[reading][text], draft.variants.scenarios
            series.setdefault(name, []).append((ranking.alpha, *counts))
    return {name: sorted(points) for name, points in sorted(series.items())}


def _describe_head(report: HeadReport) -> dict[str, Any]:
    head = report.head
    weights: Mapping[str, float] = dict(zip(head.features, head.coefficients, strict=True))
    rows = [
        [
            name,
            meaning,
            f"{weights[name]:+.2f}" if name in weights else "constant",
            f"{report.single_feature_auc[name]:.3f}",
        ]
        for name, meaning in FEATURES.items()
    ]
    caption = "Success rate against the predicted probability, of grasps in scenarios that were not fitted to."
    return {
        "skill": tabulate_skill(report),
        "plot": plot_rate_curves({"head": list(report.bins)}, "predicted probability", caption, diagonal=True),
        "features": Table(["feature", "meaning", "weight per standard deviation", "AUC alone"], rows),
    }


def _list(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))
