"""Made-up rows of a benchmark, with features by which it is known who succeeds."""

from __future__ import annotations

import json
import zlib
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.scenarios import Scenario, grid
from z1_runtime.config import RuntimeConfig
from z1_runtime.grasping.ranking import FEATURES


def scenarios(*seeds: int) -> list[Scenario]:
    return grid(seeds=seeds)


def number_of(method: str) -> int:
    """Return a number that hardly any two methods share, the same in every run."""
    return zlib.crc32(method.encode()) % 997


def episode(scenario: Scenario, method: str, success: bool, *, candidate: int = 0, rank: int = 0, **more) -> Row:
    """Return a row with random features, of which `down` alone determines the success of the executed grasp."""
    rng = np.random.default_rng([scenario.draw_seed, number_of(method)])
    measured = dict(zip(FEATURES, rng.uniform(0.2, 0.8, len(FEATURES)), strict=True))
    grasp = measured | {"down": rng.normal(0.3 if success else 0.7, 0.1)}
    first = grasp if rank == 0 else measured | {"down": rng.normal(0.9, 0.1)}
    row = {
        **scenario.columns(), "method": method, "version": "0", "success": success, "attempts": 1,
        "success_top1": success and rank == 0, "success_after": [success], "mode": "success" if success else "missed",
        "rank": rank, "candidate": candidate, "first_candidate": candidate if rank == 0 else 1000 + candidate,
        "alignment": grasp["alignment"], "generator_score": grasp["generator"],
        "first_box_alignment": first["alignment"],
    }  # fmt: skip
    row |= {f"grasp_{name}": float(value) for name, value in grasp.items()}
    row |= {f"first_{name}": float(value) for name, value in first.items()}
    return row | more


def write_run(folder: Path, rows: list[Row], config: RuntimeConfig | None = None) -> Path:
    """Write `rows` as a benchmark does."""
    folder.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(rows), folder / "episodes.parquet")
    run = {"settings": asdict(config or RuntimeConfig())}
    (folder / "summary.json").write_text(json.dumps({"run": run}))
    return folder
