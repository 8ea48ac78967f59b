"""The report's tables: the paper's figures beside ours, retries, methods against each other, candidates and times."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.scenarios import DISTANCES_M, LATERALS_M
from sim_twin.benchmark.report import paper
from sim_twin.benchmark.results.summary import STAGES

READINGS = {
    "fallthrough": ("success", "the first candidate with IK, path and clearance is executed"),
    "top1": ("success_top1", "only the first-ranked candidate counts"),
}
"""Reading to its column, and what it says."""
_COUNTS = {
    "n_candidates": "generated",
    "n_free": "free of the point cloud",
    "n_ranked": "ranked",
    "rank": "rank of the executed (0 is first)",
}
_UNKNOWN = "–"


def success(methods: Mapping[str, Any]) -> str:
    """Return the paper's first table beside ours: success overall."""
    lines = [
        [
            name,
            str(method["episodes"]),
            f"{method['rate']:.1%}",
            interval(method["rate_95"]),
            f"{method['rate_top1']:.1%}",
            interval(method["rate_top1_95"]),
            f"{paper.RATES[name]:.1%} of {paper.EPISODES}" if name in paper.RATES else _UNKNOWN,
        ]
        for name, method in methods.items()
    ]
    head = ["method", "episodes", "fallthrough", "95 %", "top1", "95 %", "the paper's"]
    notes = "; ".join(f"{reading}: {words}" for reading, (_, words) in READINGS.items())
    return table(head, lines) + _note(f"Two readings of the same episodes. {notes}. Intervals: Wilson.")


def breakdown(own: Mapping[str, Sequence[Row]], columns: Sequence[str]) -> str:
    """Return one of the paper's tables beside ours: success, in both readings, by the values of `columns`."""
    conditions = [
        (column, value)
        for column in columns
        for value in ordered(column, {row.get(column) for part in own.values() for row in part} - {None})
    ]
    lines = []
    for name, part in own.items():
        for reading, (flag, _) in READINGS.items():
            cells = [_share(part, flag)]
            cells += [_share([row for row in part if row.get(c) == value], flag) for c, value in conditions]
            lines.append([name if reading == "fallthrough" else "", reading, *cells])
        if name in paper.RATES:
            lines.append(["", "the paper's", f"{paper.RATES[name]:.1%}", *([_UNKNOWN] * len(conditions))])
    return table(["method", "", "all", *(said(value) for _, value in conditions)], lines)


def times(own: Mapping[str, Sequence[Row]]) -> str:
    """Return the paper's last table beside ours: how long a decision takes, stage by stage."""
    lines = []
    for name, part in own.items():
        values = [_values(part, column) for column in STAGES]
        together = np.array([sum(row.get(column) or 0.0 for column in STAGES) for row in part])
        lines += [
            [name if label == "median" else "", label, *(_figure(v, of, "{:.1f}") for v in (*values, together))]
            for label, of in (("median", np.median), ("95 %", lambda v: np.percentile(v, 95)))
        ]
    stages = [*(column.removesuffix("_ms") for column in STAGES), "together"]
    known = [f"{paper.TIMES_MS[stage]:g}" if stage in paper.TIMES_MS else _UNKNOWN for stage in stages]
    note = (
        "Filter: the collision check of all candidates, which full does without; collision: of those that the planner "
        "looks at; rank: fit of the box, filter by it, scores. The paper's times are a GPU's, together without "
        "detection. With several episodes side by side stages wait for each other: a deployed arm's are shorter."
    )
    return table(["method", "[ms]", *stages], [*lines, ["the paper's", "", *known]]) + _note(note)


def retries(own: Mapping[str, Sequence[Row]]) -> str:
    """Return success after each attempt, or nothing where there was one only."""
    most = max((row.get("top_k") or 1 for part in own.values() for row in part), default=1)
    if most == 1:
        return ""
    lines = []
    for name, part in own.items():
        after = [
            [bool(row["success_after"][min(k, len(row["success_after"])) - 1]) for row in part]
            for k in range(1, most + 1)
        ]
        lines.append(
            [name, *(f"{np.mean(flags):.1%}" for flags in after), _figure(_values(part, "attempts"), np.mean, "{:.2f}")]
        )
    head = ["method", *(f"within {k}" for k in range(1, most + 1)), "attempts, mean"]
    note = "After a failure the scene is looked at again as it then is, and a new grasp decided on."
    return f"<h2>Retries</h2>{table(head, lines)}{_note(note)}"


def paired(pairs: Sequence[Mapping[str, Any]]) -> str:
    """Return the methods against each other."""
    if not pairs:
        return "<p>One method only: there is nothing to compare.</p>"
    lines = [
        [
            pair["reading"],
            " and ".join(pair["methods"]),
            str(pair["scenarios"]),
            str(pair["only_first"]),
            str(pair["only_second"]),
            f"{100 * pair['difference']:+.1f}",
            "{:+.1f} to {:+.1f}".format(*(100 * bound for bound in pair["difference_95"])),
            f"{pair['p']:.2g}",
        ]
        for pair in pairs
    ]
    head = ["reading", "first and second", "scenarios", "only first", "only second", "points", "95 %", "p"]
    return table(head, lines) + _note(
        "On the same scenarios and candidates; p: McNemar, exact, two-sided; interval: Newcombe 1998, method 10."
    )


def candidates(own: Mapping[str, Sequence[Row]]) -> str:
    """Return how many candidates came how far."""
    refused = sorted(
        {column for part in own.values() for row in part for column in row if column.startswith("rejected_")}
    )
    lines = []
    for name, part in own.items():
        medians = [_figure(_values(part, column), np.median, "{:.0f}") for column in _COUNTS]
        means = [_figure(_values(part, column), np.mean, "{:.1f}") for column in refused]
        lines.append([name, *medians, *means])
    head = ["method", *_COUNTS.values(), *(f"refused: {column.removeprefix('rejected_')}" for column in refused)]
    note = "Medians an episode; refused: by the planner before it took one, or all if it took none; means an episode."
    return table(head, lines) + _note(note)


def ordered(column: str, values: set[Any]) -> list[Any]:
    """Return `values` as people count them: near to far, left to right, small to large."""
    order = {"distance": list(DISTANCES_M), "lateral": list(LATERALS_M)}.get(column)
    return sorted(values, key=order.index if order else None)


def said(value: Any) -> str:
    """Return a value of a condition in words."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def interval(bounds: Sequence[float]) -> str:
    """Return a range of rates in words."""
    return f"{bounds[0]:.1%} to {bounds[1]:.1%}"


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Return a table of text as HTML."""
    top = "".join(f"<th>{escape(word)}</th>" for word in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in line) + "</tr>" for line in lines)
    return f"<div class='wide'><table><tr>{top}</tr>{body}</table></div>"


def _note(words: str) -> str:
    return f"<p><small>{escape(words)}</small></p>"


def _share(rows: Sequence[Row], flag: str) -> str:
    return f"{np.mean([bool(row[flag]) for row in rows]):.1%}" if rows else _UNKNOWN


def _values(rows: Sequence[Row], column: str) -> np.ndarray:
    """Return what rows have in `column`; −1 stands for a count that was never made."""
    values = np.array([row[column] for row in rows if row.get(column) is not None], dtype=float)
    return values[np.isfinite(values) & (values >= 0)]


def _figure(values: np.ndarray, of: Callable[[np.ndarray], Any], form: str) -> str:
    return form.format(float(of(values))) if len(values) else _UNKNOWN
