"""The benchmark report's tables: the paper's figures next to ours, retries, paired methods, candidates and times."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.scenarios import DISTANCES_M, LATERALS_M
from sim_twin.benchmark.report import paper
from sim_twin.benchmark.results.summary import STAGES

READINGS = {
    "fallthrough": ("success", "the first candidate with IK, path and clearance is executed"),
    "top1": ("success_top1", "only the first-ranked candidate counts"),
}
"""Reading to its column and its meaning."""
_COUNTS = {
    "n_candidates": "generated",
    "n_free": "free of the point cloud",
    "n_ranked": "ranked",
    "rank": "rank of the executed (0 is first)",
}
_UNKNOWN = "–"


class Table(NamedTuple):
    """Text of a table, with a note below it."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


def tabulate_success(methods: Mapping[str, Any]) -> Table:
    """Return the paper's first table next to ours: success overall."""
    rows = [
        [
            name,
            str(method["episodes"]),
            f"{method['rate']:.1%}",
            format_interval(method["rate_95"]),
            f"{method['rate_top1']:.1%}",
            format_interval(method["rate_top1_95"]),
            f"{paper.RATES[name]:.1%} of {paper.EPISODES}" if name in paper.RATES else _UNKNOWN,
        ]
        for name, method in methods.items()
    ]
    head = ["method", "episodes", "fallthrough", "95 %", "top1", "95 %", "the paper's"]
    notes = "; ".join(f"{reading}: {words}" for reading, (_, words) in READINGS.items())
    return Table(head, rows, f"Two readings of the same episodes. {notes}. Intervals: Wilson.")


def tabulate_conditions(by_method: Mapping[str, Sequence[Row]], columns: Sequence[str]) -> Table:
    """Return one of the paper's tables next to ours: success, in both readings, by the values of `columns`."""
    conditions = [
        (column, value)
        for column in columns
        for value in sort_values(column, {row.get(column) for part in by_method.values() for row in part} - {None})
    ]
    rows = []
    for name, part in by_method.items():
        for reading, (flag, _) in READINGS.items():
            cells = [_format_rate(part, flag)]
            cells += [_format_rate([row for row in part if row.get(c) == value], flag) for c, value in conditions]
            rows.append([name if reading == "fallthrough" else "", reading, *cells])
        if name in paper.RATES:
            rows.append(["", "the paper's", f"{paper.RATES[name]:.1%}", *([_UNKNOWN] * len(conditions))])
    return Table(["method", "", "all", *(format_value(value) for _, value in conditions)], rows)


def tabulate_times(by_method: Mapping[str, Sequence[Row]]) -> Table:
    """Return the paper's last table next to ours: the duration of a decision, stage by stage."""
    rows = []
    for name, part in by_method.items():
        values = [_values(part, column) for column in STAGES]
        timed = [row for row in part if any(row.get(column) is not None for column in STAGES)]
        together = np.array([sum(row.get(column) or 0.0 for column in STAGES) for row in timed])
        rows += [
            [name if label == "median" else "", label, *(_format(v, of, "{:.1f}") for v in (*values, together))]
            for label, of in (("median", np.median), ("95 %", lambda v: np.percentile(v, 95)))
        ]
    stages = [*(column.removesuffix("_ms") for column in STAGES), "together"]
    known = [f"{paper.TIMES_MS[stage]:g}" if stage in paper.TIMES_MS else _UNKNOWN for stage in stages]
    note = (
        "Filter: the collision check of all candidates, which full does without; collision: of those that the planner "
        "checks; rank: fit of the box, filter by it, scores. The paper's times are a GPU's, together without "
        "detection. With several worker processes stages wait for each other: a deployed arm's are shorter."
    )
    return Table(["method", "[ms]", *stages], [*rows, ["the paper's", "", *known]], note)


def tabulate_retries(by_method: Mapping[str, Sequence[Row]]) -> Table | None:
    """Return success after each attempt, or None where there was one only."""
    attempts = max((row.get("top_k") or 1 for part in by_method.values() for row in part), default=1)
    if attempts == 1:
        return None
    rows = []
    for name, part in by_method.items():
        after = [
            [bool(row["success_after"][min(k, len(row["success_after"])) - 1]) for row in part]
            for k in range(1, attempts + 1)
        ]
        rates = [f"{np.mean(flags):.1%}" for flags in after]
        rows.append([name, *rates, _format(_values(part, "attempts"), np.mean, "{:.2f}")])
    head = ["method", *(f"within {k}" for k in range(1, attempts + 1)), "attempts, mean"]
    return Table(head, rows, "After a failure the scene as it then is is captured again, and a new grasp is planned.")


def tabulate_pairs(pairs: Sequence[Mapping[str, Any]]) -> Table | None:
    """Return the methods against each other, or None where there is one only."""
    if not pairs:
        return None
    rows = [
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
    note = "On the same scenarios and candidates; p: McNemar, exact, two-sided; interval: Newcombe 1998, method 10."
    return Table(head, rows, note)


def tabulate_candidates(by_method: Mapping[str, Sequence[Row]]) -> Table:
    """Return the numbers of candidates after each stage."""
    rejected = sorted(
        {column for part in by_method.values() for row in part for column in row if column.startswith("rejected_")}
    )
    rows = []
    for name, part in by_method.items():
        medians = [_format(_values(part, column), np.median, "{:.0f}") for column in _COUNTS]
        means = [_format(_values(part, column), np.mean, "{:.1f}") for column in rejected]
        rows.append([name, *medians, *means])
    head = ["method", *_COUNTS.values(), *(f"rejected: {column.removeprefix('rejected_')}" for column in rejected)]
    note = (
        "Medians per episode; rejected: by the planner before it took a candidate, or all if it took none; means per "
        "episode."
    )
    return Table(head, rows, note)


def sort_values(column: str, values: set[Any]) -> list[Any]:
    """Return `values` in their natural order: near to far, left to right, small to large."""
    order = {"distance": list(DISTANCES_M), "lateral": list(LATERALS_M)}.get(column)
    return sorted(values, key=order.index if order else None)


def format_value(value: Any) -> str:
    """Return a value of a condition as text."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def format_interval(bounds: Sequence[float]) -> str:
    """Return a range of rates as text."""
    return f"{bounds[0]:.1%} to {bounds[1]:.1%}"


def _format_rate(rows: Sequence[Row], flag: str) -> str:
    return f"{np.mean([bool(row[flag]) for row in rows]):.1%}" if rows else _UNKNOWN


def _values(rows: Sequence[Row], column: str) -> np.ndarray:
    """Return the values of `column`; −1 marks a count that was never made."""
    values = np.array([row[column] for row in rows if row.get(column) is not None], dtype=float)
    return values[np.isfinite(values) & (values >= 0)]


def _format(values: np.ndarray, of: Callable[[np.ndarray], Any], form: str) -> str:
    return form.format(float(of(values))) if len(values) else _UNKNOWN
