"""Rows of benchmark runs for `./z1 tune`, and the grasps in them with a known outcome."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hal.base.errors import UsageError
from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.results.store import FOLDER, TABLE
from z1_runtime.config import RuntimeConfig, config_from
from z1_runtime.grasping.ranking import FEATURES

Reading = Literal["top1", "fallthrough"]
"""`top1`: only the first-ranked grasp counts; `fallthrough`: the first reachable one is executed."""
Outcomes = dict[str, dict[str, bool]]
"""Success by method and scenario."""


class TuneError(UsageError):
    """Rows without information for the tuning, or of runs that cannot be combined."""

    default_code = "tune"


@dataclass(frozen=True, slots=True, kw_only=True)
class Logs:
    """The rows of some runs under the same settings."""

    rows: list[Row]
    config: RuntimeConfig
    """Settings of the runs."""
    sources: tuple[str, ...]

    @property
    def seeds(self) -> tuple[int, ...]:
        """Return the seeds, in order."""
        return tuple(sorted({row["seed"] for row in self.rows}))


def load_logs(folders: Sequence[Path]) -> Logs:
    """Return the rows of benchmark runs, each scenario and method once.

    Args:
        folders: the `--out` of `./z1 bench`.

    Raises:
        TuneError: no rows, no settings, or runs with different settings.
        ConfigError: the settings are of a version that this one cannot read.
    """
    rows: dict[tuple[str, str], Row] = {}
    configs: dict[str, RuntimeConfig] = {}
    for folder in folders:
        configs[str(folder)] = _load_settings(folder)
        for row in _load_rows(folder):
            rows.setdefault((row["scenario"], row["method"]), row)
    if not rows:
        raise TuneError(
            "tune: there are no logs (0 folders with episodes, allowed 1 or more). Give the --out of a `./z1 bench`.",
            code="no_logs",
        )
    first, config = next(iter(configs.items()))
    for other, settings in configs.items():
        if settings != config:
            raise TuneError(
                f"tune: {first} and {other} were run with different settings. Give runs with the same settings.",
                code="different_settings",
            )
    ordered = [rows[key] for key in sorted(rows)]
    return Logs(rows=ordered, config=config, sources=tuple(configs))


def _load_settings(folder: Path) -> RuntimeConfig:
    path = folder / "summary.json"
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))["run"]["settings"]
    except (OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise TuneError(
            f"tune: {path} has no settings of the run. Give the --out of a `./z1 bench` that has completed.",
            code="no_settings",
        ) from error
    return config_from(settings, f"{path}: settings")


def _load_rows(folder: Path) -> list[Row]:
    """Return a run's rows, from its table or, before its end, from the folder of small files."""
    table = folder / TABLE
    paths = [table] if table.exists() else sorted((folder / FOLDER).glob("*.parquet"))
    if not paths:
        raise TuneError(
            f"tune: {folder} has no episodes (0 files, allowed 1 or more). Give the --out of a `./z1 bench`.",
            code="no_episodes",
        )
    return pa.concat_tables([pq.read_table(path) for path in paths], promote_options="permissive").to_pylist()


def scenario_pose(row: Mapping[str, Any]) -> str:
    """Return the scenario of a row without its seed, the group of the cross-validation."""
    return row["scenario"].rpartition("-s")[0]


def is_success(row: Mapping[str, Any], reading: Reading) -> bool:
    """Return whether the first attempt of an episode succeeded."""
    if reading == "top1":
        return bool(row["success_top1"])
    after = row.get("success_after")
    return bool(after[0]) if after else bool(row["success"])


def collect_outcomes(rows: Iterable[Row], reading: Reading) -> Outcomes:
    """Return the successes by method and scenario."""
    by_method: Outcomes = {}
    for row in rows:
        by_method.setdefault(row["method"], {})[row["scenario"]] = is_success(row, reading)
    return by_method


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Samples:
    """N different grasps with a known outcome."""

    features: np.ndarray
    """(N, 11) as `z1_runtime.grasping.ranking.measure` returns it."""
    success: np.ndarray
    """(N,) bool."""
    poses: np.ndarray
    """(N,) the scenarios without their seeds."""
    objects: np.ndarray
    """(N,) names."""

    def __len__(self) -> int:
        return len(self.success)

    def __getitem__(self, index: np.ndarray) -> Samples:
        return Samples(
            features=self.features[index],
            success=self.success[index],
            poses=self.poses[index],
            objects=self.objects[index],
        )


Which = Literal["first", "grasp"]
"""The first-ranked grasp of an episode, or the executed one; a row's columns begin so."""


def labelled_grasps(rows: Iterable[Row], reading: Reading) -> Iterator[tuple[Row, Which, bool]]:
    """Yield each grasp with a known outcome: its row, its column prefix, and whether it succeeded.

    An executed grasp has the outcome of its episode. Under `top1` a first-ranked grasp that was rejected as unreachable
    is a failure; under `fallthrough` its rejection costs nothing, so it is left out. Methods that chose the same grasp
    give one. Rows with retries are left out: they describe the last attempt.
    """
    found: set[tuple[str, int | None]] = set()
    for row in rows:
        if row.get("attempts", 1) != 1:
            continue
        first, grasp = (row["scenario"], row.get("first_candidate")), (row["scenario"], row.get("candidate"))
        if reading == "top1" and row.get("rank") != 0 and first[1] is not None and first not in found:
            found.add(first)
            yield row, "first", False
        if grasp[1] is not None and grasp not in found:
            found.add(grasp)
            yield row, "grasp", bool(row["success"])


def extract_samples(rows: Iterable[Row], reading: Reading) -> Samples:
    """Return the labelled grasps of `rows` with their features; rows of earlier versions have none and are left out."""
    known = [(row, _features(row, which), succeeded) for row, which, succeeded in labelled_grasps(rows, reading)]
    known = [(row, features, succeeded) for row, features, succeeded in known if features is not None]
    return Samples(
        features=np.array([features for _, features, _ in known], dtype=float).reshape(-1, len(FEATURES)),
        success=np.array([succeeded for *_, succeeded in known], dtype=bool),
        poses=np.array([scenario_pose(row) for row, *_ in known], dtype=str),
        objects=np.array([row["object"] for row, *_ in known], dtype=str),
    )


def _features(row: Row, which: Which) -> list[float] | None:
    values = [row.get(f"{which}_{name}") for name in FEATURES]
    return None if any(value is None for value in values) else [float(value) for value in values]  # pyright: ignore[reportArgumentType]
