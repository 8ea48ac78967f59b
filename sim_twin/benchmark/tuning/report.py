"""The tuning's figures for people: one self-contained page of HTML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from sim_twin.benchmark.report import svg
from sim_twin.benchmark.report.report_tables import table
from sim_twin.benchmark.tuning.fit import Family, Tuning
from sim_twin.benchmark.tuning.head import HeadReport, Skill
from sim_twin.benchmark.tuning.svg import Point, rate_curves
from sim_twin.benchmark.tuning.thresholds import Threshold
from sim_twin.benchmark.tuning.variants import format_ranking
from z1_runtime.grasping.features import FEATURES

_STYLE = """:root{color-scheme:light}body{font:15px/1.55 system-ui,sans-serif;max-width:64rem;margin:0 auto;
padding:2rem 1.5rem 4rem;color:#1a202c;background:#fff}h2{margin:2.6rem 0 .8rem;border-bottom:2px solid #e2e8f0}
figcaption,small{color:#4a5568;font-size:.86rem}figure{margin:.5rem 0}.row{display:flex;flex-wrap:wrap;gap:.5rem 2.5rem}
svg{max-width:100%;height:auto;font-family:inherit}.wide{overflow-x:auto}table{border-collapse:collapse}
td,th{padding:.28rem 1.1rem .28rem 0;text-align:left;border-bottom:1px solid #e2e8f0;white-space:nowrap}
.legend span{margin-right:1.2rem}.legend i{display:inline-block;width:.8em;height:.8em;margin-right:.35em}
.verdict{border-left:5px solid #b7791f;background:#f7fafc;padding:.6rem 1rem;margin:.8rem 0}
.won{border-color:#2f855a}"""


def write_tuning_report(tuning: Tuning, path: Path) -> None:
    """Write the report of `tuning`; the file is there only when it is whole."""
    parts = [
        "<h1>Offline calibration of the ranking</h1>",
        f"<p>Fitted to seeds {_list(tuning.train_seeds)}, judged on seeds {_list(tuning.held_out_seeds)}, by the "
        f"reading {tuning.reading}.</p>",
        *(_verdict(name, family) for name, family in tuning.families.items()),
        *(_family(name, family, tuning.reading) for name, family in tuning.families.items()),
        "<h2>Scoring head</h2>",
        f"<p>{escape(tuning.head_note)}</p>",
        _head(tuning.head) if tuning.head else "",
    ]
    head = (
        "<!doctype html><html lang='en'><meta charset='utf-8'><meta name='viewport' content='width=device-width'>"
        f"<title>Offline calibration</title><style>{_STYLE}</style>"
    )
    partial = path.with_suffix(".partial")
    partial.write_text(head + "\n".join(parts) + "</html>\n", encoding="utf-8")
    partial.replace(path)


def held_out_rows(family: Family) -> list[list[str]]:
    """Return a line for each proposal and reading: what, reading, successes, the hand-set values', p, and whether it
    won."""
    return [
        [
            format_ranking(proposal.ranking),
            reading,
            f"{tally.tuned} of {tally.scenarios}",
            f"{tally.baseline} of {tally.scenarios}",
            f"{tally.test.p:.2g}",
            "taken" if proposal.ranking == family.kept else "won" if proposal.wins else "not kept",
        ]
        for proposal in family.proposals
        for reading, tally in proposal.results.items()
    ]


HELD_OUT_HEADER = ("proposal", "reading", "successes", "set by hand", "McNemar p", "")


def threshold_row(key: str, threshold: Threshold | None) -> list[str]:
    """Return a cut in words: which, where, success below and above it out of its own fold, p, and what it led to."""
    if threshold is None:
        return [key, "–", "–", "–", "–", "no cut with more failures below it"]
    (low, n_low), (high, n_high) = threshold.below, threshold.above
    describe_verdict = "proposed" if threshold.is_significant else "does not hold out of its own fold"
    return [
        key,
        f"{threshold.value:.4g}",
        f"{low} of {n_low}",
        f"{high} of {n_high}",
        f"{threshold.p:.2g}",
        describe_verdict,
    ]


THRESHOLD_HEADER = ("threshold", "value", "worked below", "worked above", "Fisher p", "")


def skill_row(name: str, skill: Skill) -> list[str]:
    """Return what a head knows of grasps that it was not fitted to."""
    return [
        name,
        f"{skill.success} of {skill.grasps}",
        f"{skill.auc:.3f}",
        f"{skill.log_loss:.3f}",
        f"{skill.log_loss_of_base_rate:.3f}",
        f"{skill.brier:.3f}",
    ]


SKILL_HEADER = ("judged on", "success", "AUC", "log loss", "log loss of the mere share", "Brier")


def _list(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))


def _verdict(name: str, family: Family) -> str:
    won = " won" if family.tuned else ""
    return f"<p class='verdict{won}'><b>{name}</b>: {escape(family.why)}</p>"


def _family(name: str, family: Family, reading: str) -> str:
    draft, variants = family.draft, family.draft.variants
    lines = [
        [
            text,
            format_ranking(draft.rankings[text]),
            *(f"{own[text]} of {variants.scenarios}" for own in variants.successes.values()),
        ]
        for text in variants.names
    ]
    folds = ", ".join(dict.fromkeys(variants.by_fold)) or "none"
    held = held_out_rows(family)
    return "\n".join(
        [
            f"<h2>{name}</h2>",
            _curves(family, reading),
            table(["variant", "numbers", *variants.successes], lines),
            f"<p><small>On the seeds fitted to. Best: {escape(variants.chosen)}; best of a part of the scenarios: "
            f"{escape(folds)}. Choosing so and judging on the other scenarios gives {variants.cross_validated} of "
            f"{variants.scenarios} ({reading}), the hand-set values {variants.successes[reading][name]}.</small></p>",
            table(THRESHOLD_HEADER, [threshold_row(key, cut) for key, cut in draft.thresholds.items()]),
            table(HELD_OUT_HEADER, held) if held else "<p>Nothing was judged on held-out seeds.</p>",
        ]
    )


def _curves(family: Family, reading: str) -> str:
    """Return success against α, a line for each k and box; of variants that differ in nothing else."""
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
            tally = draft.variants.successes[reading][text], draft.variants.scenarios
            series.setdefault(name, []).append((ranking.alpha, *tally))
    series = {name: sorted(points) for name, points in sorted(series.items())}
    caption = f"Success ({reading}) on the seeds fitted to, against α; lines are 95 % intervals."
    return svg.legend(list(series)) + rate_curves(series, "α", caption)


def _head(report: HeadReport) -> str:
    head = report.head
    weights: Mapping[str, float] = dict(zip(head.features, head.coefficients, strict=True))
    lines = [
        [
            name,
            meaning,
            f"{weights[name]:+.2f}" if name in weights else "does not vary",
            f"{report.single_feature_auc[name]:.3f}",
        ]
        for name, meaning in FEATURES.items()
    ]
    caption = "Share that worked against the probability told, of grasps in scenarios that were not fitted to."
    skills = [skill_row("other scenarios", report.skill)]
    skills += [skill_row(f"{name}, fitted to the others", skill) for name, skill in report.objects.items()]
    return "\n".join(
        [
            table(SKILL_HEADER, skills),
            rate_curves({"head": list(report.bins)}, "probability told", caption, diagonal=True),
            table(["feature", "meaning", "weight of one deviation", "AUC alone"], lines),
        ]
    )
