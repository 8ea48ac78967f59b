"""Summary of rows: success rates with intervals, by condition, and methods against each other."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from hal.base.files import atomic_write
from sim_twin.benchmark.episodes.execution import Mode
from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.results.stats import mcnemar, paired_difference, wilson

CONDITIONS = ("object", "distance", "lateral", "pitch_deg", "occlusion", "clutter", "physics_noise")
"""Columns by which success is broken down."""
STAGES = ("detect_ms", "cloud_ms", "generate_ms", "filter_ms", "rank_ms", "collision_ms", "ik_ms", "plan_ms")
"""Columns of a decision's times."""
_COUNTS = ("n_candidates", "n_free", "n_ranked", "rank")


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the summary of all `rows`: under `methods` each method's own, under `paired` each two compared."""
    names = list(dict.fromkeys(row["method"] for row in rows))
    by_method = {name: [row for row in rows if row["method"] == name] for name in names}
    return {
        "methods": {name: summarise_method(own) for name, own in by_method.items()},
        "paired": [_compare(a, b, by_method, reading) for a, b in combinations(names, 2) for reading in _READINGS],
    }


_READINGS = {"fallthrough": "success", "top1": "success_top1"}


def summarise_method(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the summary of one method's rows."""
    n, successes, top1 = len(rows), *(_count(rows, column) for column in _READINGS.values())
    return {
        "episodes": n,
        "successes": successes,
        "rate": successes / n if n else float("nan"),
        "rate_95": wilson(successes, n),
        "successes_top1": top1,
        "rate_top1": top1 / n if n else float("nan"),
        "rate_top1_95": wilson(top1, n),
        "rate_after": _rates_after(rows),
        "errors": sum(row["mode"] == Mode.ERROR.value for row in rows),
        "modes": dict(Counter(row["mode"] for row in rows).most_common()),
        "by": {column: _breakdown(rows, column) for column in CONDITIONS},
        "counts": {column: _median(rows, column) for column in _COUNTS},
        "latency_ms": {column.removesuffix("_ms"): _median(rows, column) for column in STAGES},
    }


def write_summary(rows: Sequence[Row], path: Path, run: dict[str, Any]) -> dict[str, Any]:
    """Write summary.json at `path`, with the settings `run`, and return its content."""
    content = {"run": run, **summarise(rows)}
    atomic_write(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    return content


def _breakdown(rows: Sequence[Row], column: str) -> dict[str, dict[str, Any]]:
    parts: dict[str, list[Row]] = {}
    for row in rows:
        if row.get(column) is not None:
            parts.setdefault(str(row[column]), []).append(row)
    return {
        value: {
            "episodes": len(part),
            "successes": _count(part, "success"),
            "rate": _count(part, "success") / len(part),
            "rate_top1": _count(part, "success_top1") / len(part),
            "rate_95": wilson(_count(part, "success"), len(part)),
        }
        for value, part in parts.items()
    }


def _rates_after(rows: Sequence[Row]) -> list[float]:
    """Return the rate of success within one, two, … attempts, up to the maximum of any row."""
    after = [row["success_after"] for row in rows if row.get("success_after")]
    maximum = max(map(len, after), default=0)
    return [float(np.mean([flags[min(k, len(flags) - 1)] for flags in after])) for k in range(maximum)]


def _compare(a: str, b: str, by_method: dict[str, list[Row]], reading: str) -> dict[str, Any]:
    """Return the paired comparison of methods `a` and `b` on the scenarios both have."""
    column = _READINGS[reading]
    first, second = ({row["scenario"]: row[column] for row in by_method[name]} for name in (a, b))
    shared = [scenario for scenario in first if scenario in second]
    ours, theirs = np.array([first[s] for s in shared]), np.array([second[s] for s in shared])
    test = mcnemar(ours, theirs)
    return {
        "methods": [a, b],
        "reading": reading,
        "scenarios": len(shared),
        "only_first": test.only_first,
        "only_second": test.only_second,
        "p": test.p,
        "difference": (test.only_first - test.only_second) / len(shared) if shared else float("nan"),
        "difference_95": paired_difference(ours, theirs) if shared else (float("nan"), float("nan")),
    }


def _count(rows: Sequence[Row], column: str) -> int:
    return sum(bool(row[column]) for row in rows)


def _median(rows: Sequence[Row], column: str) -> float | None:
    values = [row[column] for row in rows if row.get(column) is not None]
    return float(np.median(values)) if values else None
