"""report.html: the benchmark's figures for people, on one page that needs nothing else."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from sim_twin.bench import svg
from sim_twin.bench.methods import METHODS
from sim_twin.bench.rows import Row
from sim_twin.bench.scenarios import DISTANCES_M, LATERALS_M
from sim_twin.bench.summary import STAGES

PAPER_RATES = {"vanilla": 0.247, "mvb": 0.593}
"""The paper's success rates, 81 episodes each; no other of its figures is given here."""
_READINGS = {
    "fallthrough": ("success", "the first candidate with IK, path and clearance is executed"),
    "top1": ("success_top1", "only the first-ranked candidate counts"),
}
_CONDITIONS = {
    "object": "Object",
    "distance": "Distance",
    "lateral": "Lateral position",
    "pitch_deg": "Pitch [°]",
    "occlusion": "Share of the object that is hidden",
}
_COUNTS = {
    "n_candidates": "generated",
    "n_free": "free of the point cloud",
    "n_ranked": "ranked",
    "rank": "rank of the executed (0 is first)",
}
_STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem;color:#1a202c;
background:#fff}h1,h2{line-height:1.2}h2{margin-top:2.2rem}figcaption,small{color:#4a5568}
figure{margin:.5rem 0;max-width:100%}svg{max-width:100%;height:auto}.row{display:flex;flex-wrap:wrap;gap:.5rem 2rem}
table{border-collapse:collapse}td,th{padding:.2rem 1rem .2rem 0;text-align:left;border-bottom:1px solid #e2e8f0}
.legend span{margin-right:1.2rem;white-space:nowrap}.legend i{display:inline-block;width:.8em;height:.8em;
margin-right:.35em}pre{background:#f7fafc;padding:.6rem;white-space:pre-wrap;overflow-wrap:anywhere}
.pictures figure{width:21rem}.pictures img{width:100%}"""


def write_report(
    rows: Sequence[Row], summary: Mapping[str, Any], path: Path, pictures: Mapping[str, bytes] | None = None
) -> None:
    """Write the report of a run.

    Args:
        rows: of all methods.
        summary: of these rows, as `sim_twin.bench.summary.write_summary` returns it.
        path: of the HTML file; it is replaced once the new one is whole.
        pictures: JPEG files by what is said below each.
    """
    names = sorted(summary["methods"], key=lambda name: list(METHODS).index(name.partition(":")[0]))
    methods = {name: summary["methods"][name] for name in names}
    own = {name: [row for row in rows if row["method"] == name] for name in names}
    title = "Grasping benchmark"
    parts = [
        f"<h1>{title}</h1>",
        _scope(rows, summary.get("run", {})),
        "<h2>Success</h2>" + _headline(methods),
        "<h2>Methods against each other</h2>" + _paired(summary["paired"]),
        *(_condition(column, words, own) for column, words in _CONDITIONS.items()),
        "<h2>Distance × lateral position</h2>" + _grids(own),
        "<h2>How episodes ended</h2>" + _modes(methods),
        "<h2>Candidates</h2>" + _candidates(own),
        "<h2>Latency</h2>" + _latency(own),
        _gallery(pictures or {}),
    ]
    head = f"<!doctype html><html lang='en'><meta charset='utf-8'><title>{title}</title><style>{_STYLE}</style>"
    partial = path.with_suffix(".partial")
    partial.write_text(head + "\n".join(parts) + "</html>\n", encoding="utf-8")
    partial.replace(path)


def _scope(rows: Sequence[Row], run: Mapping[str, Any]) -> str:
    scenarios = {row["scenario"] for row in rows}
    seeds = sorted({row["seed"] for row in rows})
    words = f"{len(scenarios)} scenarios, {len(rows)} episodes; seeds {', '.join(map(str, seeds))}."
    if "version" in run:
        words += f" Version {run['version']}."
    text = escape(json.dumps(run, indent=1, ensure_ascii=False, default=str))
    settings = f"<details><summary>What was run</summary><pre>{text}</pre></details>" if run else ""
    return f"<p>{escape(words)}</p>{settings}"


def _headline(methods: Mapping[str, Any]) -> str:
    lines = []
    for name, method in methods.items():
        paper = PAPER_RATES.get(name)
        lines.append(
            [
                name,
                str(method["episodes"]),
                f"{method['rate']:.1%}",
                _interval(method["rate_95"]),
                f"{method['rate_top1']:.1%}",
                _interval(method["rate_top1_95"]),
                "–" if paper is None else f"{paper:.1%} of 81",
            ]
        )
    table = _table(["method", "episodes", "fallthrough", "95 %", "top1", "95 %", "the paper's"], lines)
    notes = "; ".join(f"{reading}: {words}" for reading, (_, words) in _READINGS.items())
    notes += ". The paper's figures are those of its own 81 episodes: three objects in 27 poses"
    return f"{table}<p><small>Two readings of the same episodes. {escape(notes)}. Intervals: Wilson.</small></p>"


def _paired(pairs: Sequence[Mapping[str, Any]]) -> str:
    if not pairs:
        return "<p>One method only: there is nothing to compare.</p>"
    lines = [
        [
            pair["reading"],
            " and ".join(pair["methods"]),
            str(pair["scenarios"]),
            str(pair["only_first"]),
            str(pair["only_second"]),
            f"{pair['p']:.2g}",
        ]
        for pair in pairs
    ]
    table = _table(["reading", "first and second", "scenarios", "only first", "only second", "p"], lines)
    return f"{table}<p><small>On the same scenarios and candidates; p: McNemar, exact, two-sided.</small></p>"


def _condition(column: str, words: str, own: Mapping[str, Sequence[Row]]) -> str:
    values = _ordered(column, {row[column] for part in own.values() for row in part})
    plots = []
    for reading, (success, _) in _READINGS.items():
        series = {
            name: [_tally(part, success, lambda row, value=value: row[column] == value) for value in values]
            for name, part in own.items()
        }
        plots.append(svg.rate_bars([_name(value) for value in values], series, f"{reading}; lines are 95 % intervals"))
    return f"<h2>{words}</h2>{svg.legend(list(own))}<div class='row'>{''.join(plots)}</div>"


def _grids(own: Mapping[str, Sequence[Row]]) -> str:
    rows, columns = list(reversed(DISTANCES_M)), list(LATERALS_M)
    plots = []
    for name, part in own.items():
        for reading, (success, _) in _READINGS.items():
            cells = {
                (r, c): _tally(part, success, lambda row, r=r, c=c: (row["distance"], row["lateral"]) == (r, c))
                for r in rows
                for c in columns
            }
            plots.append(svg.rate_grid(rows, columns, cells, f"{name}, {reading}"))
    return f"<p><small>As the robot sees it, from its base.</small></p><div class='row'>{''.join(plots)}</div>"


def _modes(methods: Mapping[str, Any]) -> str:
    modes = {name: method["modes"] for name, method in methods.items()}
    return svg.share_bars(modes, "success", "Episodes by how they ended (fallthrough).")


def _candidates(own: Mapping[str, Sequence[Row]]) -> str:
    refused = sorted({column for part in own.values() for row in part for column in row if _is_refusal(column)})
    lines = []
    for name, part in own.items():
        medians = [_figure(_values(part, column), np.median, "{:.0f}") for column in _COUNTS]
        means = [_figure(_values(part, column), np.mean, "{:.1f}") for column in refused]
        lines.append([name, *medians, *means])
    head = ["method", *_COUNTS.values(), *(f"refused: {column.removeprefix('rejected_')}" for column in refused)]
    note = "Medians an episode; refused: by the planner before it took one, or all if it took none; means an episode."
    return f"{_table(head, lines)}<p><small>{note}</small></p>"


def _latency(own: Mapping[str, Sequence[Row]]) -> str:
    lines = []
    for name, part in own.items():
        values = [_values(part, column) for column in STAGES]
        totals = np.array([sum(row.get(column) or 0.0 for column in STAGES) for row in part])
        lines += [
            [name if label == "median" else "", label, *(_figure(v, of, "{:.1f}") for v in (*values, totals))]
            for label, of in (("median", np.median), ("95 %", lambda v: np.percentile(v, 95)))
        ]
    head = ["method", "[ms]", *(column.removesuffix("_ms") for column in STAGES), "together"]
    note = "With several episodes side by side stages wait for each other: a deployed arm's are shorter."
    return f"{_table(head, lines)}<p><small>{note}</small></p>"


def _gallery(pictures: Mapping[str, bytes]) -> str:
    if not pictures:
        return ""
    figures = "".join(
        f"<figure><img src='data:image/jpeg;base64,{b64encode(jpeg).decode()}' alt=''>"
        f"<figcaption>{escape(words)}</figcaption></figure>"
        for words, jpeg in pictures.items()
    )
    return f"<h2>Failures, as they ended</h2><div class='row pictures'>{figures}</div>"


def _tally(rows: Sequence[Row], column: str, belongs: Callable[[Row], bool]) -> svg.Tally:
    part = [bool(row[column]) for row in rows if belongs(row)]
    return sum(part), len(part)


def _ordered(column: str, values: set[Any]) -> list[Any]:
    """Return `values` as people count them: near to far, left to right, small to large."""
    order = {"distance": list(DISTANCES_M), "lateral": list(LATERALS_M)}.get(column)
    return sorted(values, key=order.index if order else None)


def _name(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _values(rows: Sequence[Row], column: str) -> np.ndarray:
    """Return what rows have in `column`; −1 stands for a count that was never made."""
    values = np.array([row[column] for row in rows if row.get(column) is not None], dtype=float)
    return values[np.isfinite(values) & (values >= 0)]


def _is_refusal(column: str) -> bool:
    return column.startswith("rejected_")


def _figure(values: np.ndarray, of: Callable[[np.ndarray], Any], form: str) -> str:
    return form.format(float(of(values))) if len(values) else "–"


def _interval(interval: Sequence[float]) -> str:
    return f"{interval[0]:.1%} to {interval[1]:.1%}"


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    top = "".join(f"<th>{escape(word)}</th>" for word in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in line) + "</tr>" for line in lines)
    return f"<table><tr>{top}</tr>{body}</table>"
