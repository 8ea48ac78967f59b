"""Summary and report of the oracle's rows: solvable scenarios by condition, and the methods' success on them."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from hal.base.files import atomic_write
from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.scenarios import DISTANCES_M, LATERALS_M
from sim_twin.benchmark.report.page import write_page
from sim_twin.benchmark.report.plots import Plot, plot_count_grid
from sim_twin.benchmark.report.tables import Table, format_interval, sort_values
from sim_twin.benchmark.results.stats import wilson

_BY = ("object", "pitch_deg", "distance", "lateral")
_SCENE_COLUMNS = ("object", "distance", "lateral", "pitch_deg", "occlusion", "clutter", "physics_noise")
_WITHIN = (1, 2, 5, 10, 20, 40)


def summarise(rows: Sequence[Row], others: Sequence[Row] = ()) -> dict[str, Any]:
    """Return the figures of the oracle's `rows`.

    Args:
        rows: the oracle's.
        others: episodes of a benchmark; `methods` counts their successes in solvable scenarios.
    """
    solved = [row for row in rows if row["success"]]
    return {
        **_count_solved(rows),
        "by": {column: {str(v): _count_solved(part) for v, part in _parts(rows, column).items()} for column in _BY},
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
        "methods": _compare_methods(rows, others),
    }


def write_summary(
    rows: Sequence[Row], path: Path, run: Mapping[str, Any], others: Sequence[Row] = ()
) -> dict[str, Any]:
    """Write summary.json at `path`, with the settings `run`, and return its content."""
    content = {"run": dict(run), **summarise(rows, others)}
    atomic_write(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    return content


def write_report(rows: Sequence[Row], summary: Mapping[str, Any], path: Path) -> None:
    """Write the report.

    Args:
        rows: the oracle's.
        summary: of these rows.
        path: of the HTML file.
    """
    within = [[f"{n}", f"{count} of {summary['episodes']}"] for n, count in summary["solved_within"].items()]
    run = summary.get("run", {})
    write_page(
        path,
        "oracle.html.j2",
        title="Solvable scenarios",
        solved=summary["solved"],
        episodes=summary["episodes"],
        rate=f"{summary['rate']:.1%} ({format_interval(summary['rate_95'])})",
        by=[_tabulate_condition(column, summary["by"][column]) for column in _BY],
        within=Table(["grasps executed", "solved within them"], within),
        grids=_grids(rows),
        unsolved=_tabulate_unsolved(summary["unsolved"]),
        methods=_tabulate_methods(summary["methods"]),
        run=json.dumps(run, indent=1, ensure_ascii=False, default=str) if run else "",
    )


def _count_solved(rows: Sequence[Row]) -> dict[str, Any]:
    solved = sum(bool(row["success"]) for row in rows)
    return {
        "episodes": len(rows),
        "solved": solved,
        "rate": solved / len(rows) if rows else float("nan"),
        "rate_95": wilson(solved, len(rows)),
        "verdicts": dict(Counter(row["verdict"] for row in rows).most_common()),
    }


def _parts(rows: Sequence[Row], column: str) -> dict[Any, list[Row]]:
    values = sort_values(column, {row[column] for row in rows})
    return {value: [row for row in rows if row[column] == value] for value in values}


def _compare_methods(rows: Sequence[Row], others: Sequence[Row]) -> dict[str, Any]:
    """Return per method of `others` its successes where the oracle found a grasp, and where it did not."""
    solvable = {_scene_key(row): bool(row["success"]) for row in rows}
    known = [row for row in others if _scene_key(row) in solvable]
    methods: dict[str, Any] = {}
    for name in dict.fromkeys(row["method"] for row in known):
        own = [row for row in known if row["method"] == name]
        solvable_rows = [row for row in own if solvable[_scene_key(row)]]
        solved = sum(bool(row["success"]) for row in solvable_rows)
        methods[name] = {
            "episodes": len(own),
            "solvable": len(solvable_rows),
            "solved": solved,
            "rate_of_solvable": solved / len(solvable_rows) if solvable_rows else float("nan"),
            "solved_where_the_oracle_did_not": sum(bool(row["success"]) for row in own) - solved,
        }
    return methods


def _scene_key(row: Row) -> tuple[Any, ...]:
    """Return the columns that two episodes of one scene share; each seed samples its own clutter and physics."""
    sampled = row["seed"] if row["clutter"] or row["physics_noise"] else 0
    # The oracle uses no image, so an occluded scene is the same one to it
    return *(row[column] for column in _SCENE_COLUMNS if column != "occlusion"), sampled


def _tabulate_condition(column: str, counts: Mapping[str, Any]) -> Table:
    rows = [[value, f"{c['solved']} of {c['episodes']}", f"{c['rate']:.1%}"] for value, c in counts.items()]
    return Table([column.replace("_deg", " [°]"), "solved", "ratio"], rows)


def _grids(rows: Sequence[Row]) -> list[list[Plot]]:
    """Return a line of grids for each object, one grid per pitch."""
    maximum = max((row["n_reachable"] for row in rows), default=1)
    lines = []
    for name, of_object in groupby(sorted(rows, key=lambda row: (row["object"], row["pitch_deg"])), _key("object")):
        plots = []
        for pitch, part in groupby(of_object, _key("pitch_deg")):
            cells = {(row["distance"], row["lateral"]): (row["n_reachable"], _describe_end(row)) for row in part}
            caption = f"{name}, {pitch:+g}°"
            plots.append(plot_count_grid(list(reversed(DISTANCES_M)), list(LATERALS_M), cells, maximum, caption))
        lines.append(plots)
    return lines


def _key(column: str):
    return lambda row: row[column]


def _describe_end(row: Row) -> str:
    return f"{row['executions']} executed" if row["success"] else row["verdict"]


def _tabulate_unsolved(unsolved: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        [
            item["scenario"],
            item["verdict"],
            f"{item['executions']}" + (", all kinds" if item["exhausted"] else ", budget spent"),
            ", ".join(f"{mode} {n}" for mode, n in item["modes"].items()),
        ]
        for item in unsolved
    ]
    return Table(["scenario", "verdict", "executed", "failure modes"], rows)


def _tabulate_methods(methods: Mapping[str, Any]) -> Table:
    rows = [
        [
            name,
            f"{m['solved']} of {m['solvable']}",
            f"{m['rate_of_solvable']:.1%}",
            str(m["solved_where_the_oracle_did_not"]),
        ]
        for name, m in methods.items()
    ]
    return Table(["method", "of the solvable", "ratio", "solved where the oracle found nothing"], rows)
