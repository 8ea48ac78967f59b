"""report.html of a benchmark run: the figures on one self-contained page."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sim_twin.benchmark.episodes.methods import METHODS
from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.scenarios import DISTANCES_M, LATERALS_M
from sim_twin.benchmark.report import paper, tables
from sim_twin.benchmark.report.page import write_page
from sim_twin.benchmark.report.pictures import EpisodePicture
from sim_twin.benchmark.report.plots import (
    Counts,
    Plot,
    method_keys,
    mode_keys,
    plot_mode_bars,
    plot_rate_bars,
    plot_rate_grid,
)

_CONDITIONS = {
    "object": "Object",
    "distance": "Distance",
    "lateral": "Lateral position",
    "pitch_deg": "Pitch [°]",
    "occlusion": "Occluded ratio of the object",
    "clutter": "Neighbours",
    "physics_noise": "Physics noise",
}
_ALWAYS = ("object", "distance", "lateral", "pitch_deg")
"""Conditions that are plotted even where there is but one value."""


def write_report(
    rows: Sequence[Row], summary: Mapping[str, Any], path: Path, pictures: Sequence[EpisodePicture] = ()
) -> None:
    """Write the report of a run.

    Args:
        rows: of all methods.
        summary: of these rows, as `sim_twin.benchmark.results.summary.write_summary` returns it.
        path: of the HTML file; it is replaced once the new one is complete.
        pictures: of chosen episodes.
    """
    names = sorted(summary["methods"], key=lambda name: list(METHODS).index(name.partition(":")[0]))
    methods = {name: summary["methods"][name] for name in names}
    by_method = {name: [row for row in rows if row["method"] == name] for name in names}
    modes = {name: method["modes"] for name, method in methods.items()}
    keys = mode_keys(modes, "success")
    run = summary.get("run", {})
    write_page(
        path,
        "benchmark.html.j2",
        title="Grasping benchmark",
        scope=_scope(rows, run),
        methods=method_keys(names),
        cards=_cards(methods),
        paper_episodes=paper.EPISODES,
        paper_tables=[
            ("Success", tables.tabulate_success(methods)),
            ("By object", tables.tabulate_conditions(by_method, ["object"])),
            ("By distance and lateral position", tables.tabulate_conditions(by_method, ["distance", "lateral"])),
            ("By pitch [°]", tables.tabulate_conditions(by_method, ["pitch_deg"])),
            ("Time [ms]", tables.tabulate_times(by_method)),
        ],
        paired=tables.tabulate_pairs(summary["paired"]),
        retries=tables.tabulate_retries(by_method),
        conditions=_conditions(by_method),
        grids=_grids(by_method),
        mode_keys=keys,
        mode_plot=plot_mode_bars(modes, keys, "Episodes by their outcome (fallthrough)."),
        candidates=tables.tabulate_candidates(by_method),
        pictures=[
            {"base64": b64encode(p.jpeg).decode(), "caption": p.caption, "recording": p.recording} for p in pictures
        ],
        run=json.dumps(run, indent=1, ensure_ascii=False, default=str) if run else "",
    )


def _scope(rows: Sequence[Row], run: Mapping[str, Any]) -> str:
    scenarios = {row["scenario"] for row in rows}
    seeds = sorted({row["seed"] for row in rows})
    words = f"{len(scenarios)} scenarios, {len(rows)} episodes; seeds {', '.join(map(str, seeds))}."
    return words + (f" Version {run['version']}." if "version" in run else "")


def _cards(methods: Mapping[str, Any]) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "colour": colour,
            "rate": f"{method['rate']:.1%}",
            "rate_top1": f"{method['rate_top1']:.1%}",
            "successes": method["successes"],
            "episodes": method["episodes"],
            "errors": method["errors"],
            "paper": f"the paper: {paper.RATES[name]:.1%}" if name in paper.RATES else "not in the paper",
        }
        for (name, colour), method in zip(method_keys(list(methods)), methods.values(), strict=True)
    ]


def _conditions(by_method: Mapping[str, Sequence[Row]]) -> list[dict[str, Any]]:
    """Return heading, plots and note of each condition that varies or is always plotted."""
    found = []
    for column, heading in _CONDITIONS.items():
        values = tables.sort_values(column, {row.get(column) for part in by_method.values() for row in part} - {None})
        if len(values) > 1 or column in _ALWAYS:
            note = _describe_knocked(by_method) if column == "clutter" else ""
            found.append({"heading": heading, "plots": _condition_plots(column, values, by_method), "note": note})
    return found


def _condition_plots(column: str, values: Sequence[Any], by_method: Mapping[str, Sequence[Row]]) -> list[Plot]:
    plots = []
    for reading, (flag, _) in tables.READINGS.items():
        series = {
            name: [_count(part, flag, lambda row, value=value: row.get(column) == value) for value in values]
            for name, part in by_method.items()
        }
        words = [tables.format_value(value) for value in values]
        plots.append(plot_rate_bars(words, series, f"{reading}; lines are 95 % intervals"))
    return plots


def _describe_knocked(by_method: Mapping[str, Sequence[Row]]) -> str:
    """Return how often neighbours were knocked, in a sentence."""
    parts = []
    for name, rows in by_method.items():
        among = [row for row in rows if row.get("clutter")]
        parts.append(f"{name} {sum(bool(row.get('neighbours_knocked')) for row in among)} of {len(among)}")
    return f"Episodes in which a neighbour was moved by more than 15 mm or 15°: {'; '.join(parts)}."


def _grids(by_method: Mapping[str, Sequence[Row]]) -> list[list[Plot]]:
    """Return a line of grids for each reading, one grid per method."""
    rows, columns = list(reversed(DISTANCES_M)), list(LATERALS_M)
    lines = []
    for reading, (flag, _) in tables.READINGS.items():
        plots = []
        for name, part in by_method.items():
            cells = {
                (r, c): _count(part, flag, lambda row, r=r, c=c: (row["distance"], row["lateral"]) == (r, c))
                for r in rows
                for c in columns
            }
            plots.append(plot_rate_grid(rows, columns, cells, f"{name}, {reading}"))
        lines.append(plots)
    return lines


def _count(rows: Sequence[Row], column: str, belongs: Callable[[Row], bool]) -> Counts:
    part = [bool(row[column]) for row in rows if belongs(row)]
    return sum(part), len(part)
