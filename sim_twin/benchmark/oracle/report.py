"""What the oracle's rows amount to: how much can be solved, where, how easily, and what of it a method solves."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.scenarios import DISTANCES_M, LATERALS_M
from sim_twin.benchmark.report import svg
from sim_twin.benchmark.report.report import write_page
from sim_twin.benchmark.report.report_tables import ordered, table
from sim_twin.benchmark.results.stats import wilson

_BY = ("object", "pitch_deg", "distance", "lateral")
_PLACE = ("object", "distance", "lateral", "pitch_deg", "occlusion", "clutter", "physics_noise")
_WITHIN = (1, 2, 5, 10, 20, 40)


def summarise(rows: Sequence[Row], others: Sequence[Row] = ()) -> dict[str, Any]:
    """Return what can be solved.

    Args:
        rows: the oracle's.
        others: episodes of a benchmark; under `methods` it is told how many of those in a solvable place they solved.
    """
    solved = [row for row in rows if row["success"]]
    return {
        **_tally(rows),
        "by": {column: {str(v): _tally(part) for v, part in _parts(rows, column).items()} for column in _BY},
        "solved_within": {n: sum(row["executions"] <= n for row in solved) for n in _WITHIN},
        "reachable": {
            "least": min((row["n_reachable"] for row in rows), default=0),
            "median": float(np.median([row["n_reachable"] for row in rows])) if rows else float("nan"),
        },
        "unsolved": [
            {
                "scenario": row["scenario"],
                "verdict": row["verdict"],
                "executions": row["executions"],
                "exhausted": row["exhausted"],
                "n_reachable": row["n_reachable"],
                "modes": dict(Counter(row["modes"]).most_common()),
            }
            for row in rows
            if not row["success"]
        ],
        "methods": _against(rows, others),
    }


def write_summary(
    rows: Sequence[Row], path: Path, run: Mapping[str, Any], others: Sequence[Row] = ()
) -> dict[str, Any]:
    """Write summary.json at `path`, with `run` saying what was run, and return its content."""
    content = {"run": dict(run), **summarise(rows, others)}
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    partial.replace(path)
    return content


def write_report(rows: Sequence[Row], summary: Mapping[str, Any], path: Path) -> None:
    """Write the page for people.

    Args:
        rows: the oracle's.
        summary: of these rows.
        path: of the HTML file.
    """
    low, high = summary["rate_95"]
    within = [[f"{n}", f"{count} of {summary['episodes']}"] for n, count in summary["solved_within"].items()]
    parts = [
        "<h1>What can be grasped at all</h1>",
        "<p>Grasps from all sides of the true object, checked against the true scene, and executed in the twin, each "
        "in a fresh world, until one lifts the object.</p>",
        f"<div class='cards'><div class='card'>solved<strong>{summary['solved']} of {summary['episodes']}</strong>"
        f"<span>{summary['rate']:.1%} ({low:.1%} to {high:.1%})</span></div></div>",
        "<h2>By condition</h2><div class='row'>",
        *(f"<div>{_by_table(column, summary['by'][column])}</div>" for column in _BY),
        "</div>",
        "<h2>Executions it took</h2>" + table(["grasps executed", "solved within them"], within),
        "<h2>Ways that the arm can go</h2><p><small>Of the first sweep, two flips a grasp; below each how many were "
        "executed until one held. As the robot sees it, from its base.</small></p>" + _grids(rows),
        "<h2>Not solved</h2>" + _unsolved(summary["unsolved"]),
        _methods(summary["methods"]),
        f"<h2>What was run</h2><pre>{escape(json.dumps(summary.get('run', {}), ensure_ascii=False))}</pre>",
    ]
    write_page(path, "What can be grasped at all", parts)


def _tally(rows: Sequence[Row]) -> dict[str, Any]:
    solved = sum(bool(row["success"]) for row in rows)
    return {
        "episodes": len(rows),
        "solved": solved,
        "rate": solved / len(rows) if rows else float("nan"),
        "rate_95": wilson(solved, len(rows)),
        "verdicts": dict(Counter(row["verdict"] for row in rows).most_common()),
    }


def _parts(rows: Sequence[Row], column: str) -> dict[Any, list[Row]]:
    values = ordered(column, {row[column] for row in rows})
    return {value: [row for row in rows if row[column] == value] for value in values}


def _against(rows: Sequence[Row], others: Sequence[Row]) -> dict[str, Any]:
    """Return per method of `others` how it did where the oracle found a grasp, and where it did not."""
    solvable = {_place(row): bool(row["success"]) for row in rows}
    known = [row for row in others if _place(row) in solvable]
    methods: dict[str, Any] = {}
    for name in dict.fromkeys(row["method"] for row in known):
        own = [row for row in known if row["method"] == name]
        can = [row for row in own if solvable[_place(row)]]
        done = sum(bool(row["success"]) for row in can)
        methods[name] = {
            "episodes": len(own),
            "solvable": len(can),
            "solved": done,
            "rate_of_solvable": done / len(can) if can else float("nan"),
            "solved_where_the_oracle_did_not": sum(bool(row["success"]) for row in own) - done,
        }
    return methods


def _place(row: Row) -> tuple[Any, ...]:
    """Return what makes two episodes one scene; clutter and physics are drawn anew for each seed."""
    sample = row["seed"] if row["clutter"] or row["physics_noise"] else 0
    return *(row[column] for column in _PLACE if column != "occlusion"), sample


def _by_table(column: str, tallies: Mapping[str, Any]) -> str:
    lines = [[value, f"{t['solved']} of {t['episodes']}", f"{t['rate']:.1%}"] for value, t in tallies.items()]
    return table([column.replace("_deg", " [°]"), "solved", "share"], lines)


def _grids(rows: Sequence[Row]) -> str:
    """Return a line of grids for each object, one grid a pitch."""
    most = max((row["n_reachable"] for row in rows), default=1)
    lines = []
    for name, of_object in groupby(sorted(rows, key=lambda row: (row["object"], row["pitch_deg"])), _key("object")):
        plots = []
        for pitch, part in groupby(of_object, _key("pitch_deg")):
            cells = {(row["distance"], row["lateral"]): (row["n_reachable"], _word(row)) for row in part}
            plots.append(
                svg.count_grid(list(reversed(DISTANCES_M)), list(LATERALS_M), cells, most, f"{name}, {pitch:+g}°")
            )
        lines.append(f"<div class='row'>{''.join(plots)}</div>")
    return "".join(lines)


def _key(column: str):
    return lambda row: row[column]


def _word(row: Row) -> str:
    return f"{row['executions']} executed" if row["success"] else row["verdict"]


def _unsolved(unsolved: Sequence[Mapping[str, Any]]) -> str:
    if not unsolved:
        return "<p>Nothing: every scenario has a grasp that holds.</p>"
    lines = [
        [
            item["scenario"],
            item["verdict"],
            f"{item['executions']}" + (", all kinds" if item["exhausted"] else ", budget spent"),
            ", ".join(f"{mode} {n}" for mode, n in item["modes"].items()),
        ]
        for item in unsolved
    ]
    return table(["scenario", "verdict", "executed", "how they ended"], lines)


def _methods(methods: Mapping[str, Any]) -> str:
    if not methods:
        return ""
    lines = [
        [
            name,
            f"{m['solved']} of {m['solvable']}",
            f"{m['rate_of_solvable']:.1%}",
            str(m["solved_where_the_oracle_did_not"]),
        ]
        for name, m in methods.items()
    ]
    head = ["method", "of what can be solved", "share", "solved where the oracle found nothing"]
    return "<h2>What the methods make of it</h2>" + table(head, lines)
