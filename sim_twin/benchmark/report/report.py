"""report.html: the benchmark's figures for people, on one page that needs nothing else."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sim_twin.benchmark.episodes.methods import METHODS
from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.scenarios import DISTANCES_M, LATERALS_M
from sim_twin.benchmark.report import paper, svg
from sim_twin.benchmark.report import report_tables as tables
from sim_twin.benchmark.report.pictures import EpisodePicture

_CONDITIONS = {
    "object": "Object",
    "distance": "Distance",
    "lateral": "Lateral position",
    "pitch_deg": "Pitch [°]",
    "occlusion": "Share of the object that is hidden",
    "clutter": "Neighbours",
    "physics_noise": "Physics noise",
}
_ALWAYS = ("object", "distance", "lateral", "pitch_deg")
"""Conditions that are plotted even where there is but one value."""
_STYLE = """:root{color-scheme:light}body{font:15px/1.55 system-ui,sans-serif;max-width:74rem;margin:0 auto;
padding:2rem 1.5rem 4rem;color:#1a202c;background:#fff}h1{font-size:2rem;margin:0 0 .3rem}h1,h2,h3{line-height:1.2}
h2{margin:2.8rem 0 .8rem;padding-bottom:.35rem;border-bottom:2px solid #e2e8f0}
h3{margin:1.6rem 0 .4rem;font-size:1.02rem}figcaption,small{color:#4a5568;font-size:.86rem}
figure{margin:.5rem 0;max-width:100%}svg{max-width:100%;height:auto;font-family:inherit}
.row{display:flex;flex-wrap:wrap;gap:.5rem 2.5rem}.wide{overflow-x:auto}
table{border-collapse:collapse;font-variant-numeric:tabular-nums}
td,th{padding:.28rem 1.1rem .28rem 0;text-align:left;border-bottom:1px solid #e2e8f0;white-space:nowrap}
th{color:#4a5568;font-weight:600;font-size:.88rem}td:first-child{font-weight:600}
.cards{display:flex;flex-wrap:wrap;gap:1rem;margin:1.4rem 0}
.card{border:1px solid #e2e8f0;border-top:4px solid;border-radius:6px;padding:.8rem 1.2rem;min-width:13rem}
.card strong{display:block;font-size:2rem;line-height:1.25}.card span{display:block;color:#4a5568;font-size:.88rem}
.legend span{margin-right:1.2rem;white-space:nowrap}
.legend i{display:inline-block;width:.8em;height:.8em;margin-right:.35em;border-radius:2px}
pre{background:#f7fafc;padding:.8rem;white-space:pre-wrap;overflow-wrap:anywhere;font-size:.8rem}
.pictures figure{width:21.5rem}.pictures img{width:100%;border-radius:6px;display:block}a{color:#2b6cb0}"""


def write_report(
    rows: Sequence[Row], summary: Mapping[str, Any], path: Path, pictures: Sequence[EpisodePicture] = ()
) -> None:
    """Write the report of a run.

    Args:
        rows: of all methods.
        summary: of these rows, as `sim_twin.benchmark.results.summary.write_summary` returns it.
        path: of the HTML file; it is replaced once the new one is whole.
        pictures: of chosen episodes.
    """
    names = sorted(summary["methods"], key=lambda name: list(METHODS).index(name.partition(":")[0]))
    methods = {name: summary["methods"][name] for name in names}
    own = {name: [row for row in rows if row["method"] == name] for name in names}
    title = "Grasping benchmark"
    parts = [
        f"<h1>{title}</h1>",
        _scope(rows, summary.get("run", {})),
        _cards(methods),
        "<h2>The paper's tables, and ours</h2>",
        f"<p><small>The paper's figures are of its own {paper.EPISODES} episodes: three objects in 27 poses. Of them "
        "only those that stand here are known to us.</small></p>",
        "<h3>1 Success</h3>" + tables.success(methods),
        "<h3>2 By object</h3>" + tables.breakdown(own, ["object"]),
        "<h3>3 By distance and lateral position</h3>" + tables.breakdown(own, ["distance", "lateral"]),
        "<h3>4 By pitch [°]</h3>" + tables.breakdown(own, ["pitch_deg"]),
        "<h3>5 Time [ms]</h3>" + tables.times(own),
        "<h2>Methods against each other</h2>" + tables.paired(summary["paired"]),
        tables.retries(own),
        *(_condition(column, words, own) for column, words in _CONDITIONS.items()),
        "<h2>Distance × lateral position</h2>" + _grids(own),
        "<h2>How episodes ended</h2>" + _modes(methods),
        "<h2>Candidates</h2>" + tables.candidates(own),
        _gallery(pictures),
        _settings(summary.get("run", {})),
    ]
    write_page(path, title, parts)


def write_page(path: Path, title: str, parts: Sequence[str]) -> None:
    """Write a page of `parts` (HTML) in the reports' style; it replaces the one at `path` once it is whole."""
    head = (
        f"<!doctype html><html lang='en'><meta charset='utf-8'><meta name='viewport' content='width=device-width'>"
        f"<title>{escape(title)}</title><style>{_STYLE}</style>"
    )
    partial = path.with_suffix(".partial")
    partial.write_text(head + "\n".join(parts) + "</html>\n", encoding="utf-8")
    partial.replace(path)


def _scope(rows: Sequence[Row], run: Mapping[str, Any]) -> str:
    scenarios = {row["scenario"] for row in rows}
    seeds = sorted({row["seed"] for row in rows})
    words = f"{len(scenarios)} scenarios, {len(rows)} episodes; seeds {', '.join(map(str, seeds))}."
    if "version" in run:
        words += f" Version {run['version']}."
    return f"<p>{escape(words)}</p>"


def _cards(methods: Mapping[str, Any]) -> str:
    cards = []
    for k, (name, method) in enumerate(methods.items()):
        known = f"the paper: {paper.RATES[name]:.1%}" if name in paper.RATES else "not in the paper"
        cards.append(
            f"<div class='card' style='border-top-color:{svg.COLOURS[k % len(svg.COLOURS)]}'>{escape(name)}"
            f"<strong>{method['rate']:.1%}</strong>"
            f"<span>{method['successes']} of {method['episodes']} lifted and held</span>"
            f"<span>first-ranked alone: {method['rate_top1']:.1%}</span><span>{known}</span></div>"
        )
    return f"<div class='cards'>{''.join(cards)}</div>"


def _settings(run: Mapping[str, Any]) -> str:
    if not run:
        return ""
    text = escape(json.dumps(run, indent=1, ensure_ascii=False, default=str))
    return f"<h2>What was run</h2><details><summary>Command and settings</summary><pre>{text}</pre></details>"


def _condition(column: str, words: str, own: Mapping[str, Sequence[Row]]) -> str:
    values = tables.ordered(column, {row.get(column) for part in own.values() for row in part} - {None})
    if len(values) < 2 and column not in _ALWAYS:
        return ""
    plots = []
    for reading, (flag, _) in tables.READINGS.items():
        series = {
            name: [_tally(part, flag, lambda row, value=value: row.get(column) == value) for value in values]
            for name, part in own.items()
        }
        plots.append(svg.rate_bars([tables.said(v) for v in values], series, f"{reading}; lines are 95 % intervals"))
    more = _knocked(own) if column == "clutter" else ""
    return f"<h2>{words}</h2>{svg.legend(list(own))}<div class='row'>{''.join(plots)}</div>{more}"


def _knocked(own: Mapping[str, Sequence[Row]]) -> str:
    """Return how often neighbours were knocked."""
    parts = []
    for name, rows in own.items():
        among = [row for row in rows if row.get("clutter")]
        parts.append(f"{name} {sum(bool(row['neighbours_knocked']) for row in among)} of {len(among)}")
    words = f"Episodes in which a neighbour was moved by more than 15 mm or 15°: {'; '.join(parts)}."
    return f"<p><small>{escape(words)}</small></p>"


def _grids(own: Mapping[str, Sequence[Row]]) -> str:
    rows, columns = list(reversed(DISTANCES_M)), list(LATERALS_M)
    lines = []
    for reading, (flag, _) in tables.READINGS.items():
        plots = []
        for name, part in own.items():
            cells = {
                (r, c): _tally(part, flag, lambda row, r=r, c=c: (row["distance"], row["lateral"]) == (r, c))
                for r in rows
                for c in columns
            }
            plots.append(svg.rate_grid(rows, columns, cells, f"{name}, {reading}"))
        lines.append(f"<div class='row'>{''.join(plots)}</div>")
    return f"<p><small>As the robot sees it, from its base.</small></p>{''.join(lines)}"


def _modes(methods: Mapping[str, Any]) -> str:
    modes = {name: method["modes"] for name, method in methods.items()}
    return svg.share_bars(modes, "success", "Episodes by how they ended (fallthrough).")


def _gallery(pictures: Sequence[EpisodePicture]) -> str:
    if not pictures:
        return ""
    figures = "".join(
        f"<figure><img src='data:image/jpeg;base64,{b64encode(picture.jpeg).decode()}' alt=''>"
        f"<figcaption>{escape(picture.words)}{_link(picture.recording)}</figcaption></figure>"
        for picture in pictures
    )
    return f"<h2>Failures, as they ended</h2><div class='row pictures'>{figures}</div>"


def _link(recording: str) -> str:
    return f" · <a href='{quote(recording)}'>what it saw and chose (.rrd, for Rerun)</a>" if recording else ""


def _tally(rows: Sequence[Row], column: str, belongs: Callable[[Row], bool]) -> svg.Tally:
    part = [bool(row[column]) for row in rows if belongs(row)]
    return sum(part), len(part)
