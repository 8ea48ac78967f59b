"""Find the solvable scenarios: grasps all over the object's true shape, executed in the twin until one holds.

./z1 oracle                              # the paper's 81; some minutes on two cores
./z1 oracle --set extended --out out/oracle_extended
./z1 oracle --objects bottle --pitches -45 --executions 100
./z1 oracle --resume --bench out/bench   # and the methods' success on the solvable ones
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.table import Table

from hal.base.errors import InvalidValueError
from hal.base.files import plain
from scripts import cli
from scripts.support.progress import make_progress
from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.runner import run_tasks
from sim_twin.benchmark.episodes.scenarios import OBJECT_SETS, grid
from sim_twin.benchmark.oracle.report import write_report, write_summary
from sim_twin.benchmark.oracle.search import METHOD, OracleConfig, OracleTask, run_oracle_task
from sim_twin.benchmark.results.store import TABLE, Store


@dataclass(frozen=True, kw_only=True)
class Config:
    """Options of the search."""

    set: Literal["paper", "extended"] = "paper"
    """Objects: the paper's in 27 poses each, or the extended set, upright, in 9."""
    objects: tuple[str, ...] = ()
    """Objects to search; by default all of the set."""
    pitches: tuple[float, ...] = ()
    """Leans [°]; by default all."""
    distances: tuple[str, ...] = ()
    """Distances: near, mid, far; by default all."""
    laterals: tuple[str, ...] = ()
    """Lateral positions: left, centre, right; by default all."""
    clutter: tuple[int, ...] = (0,)
    """Numbers of neighbours, 0 to 3, around the object."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the neighbours; without neighbours all seeds are the same scene."""
    executions: int = 40
    """Grasps executed, as dissimilar as possible, before a scenario counts as not solved."""
    jobs: int = 2
    """Worker processes."""
    resume: bool = False
    """Continue an interrupted run in the same folder."""
    bench: Path | None = None
    """Folder of a benchmark's run, for its methods' success on the solvable scenarios."""
    out: Path = Path("out/oracle")
    """Folder for episodes/, episodes.parquet, summary.json and report.html."""

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise InvalidValueError(
                f"oracle: jobs is out of range ({self.jobs}, allowed 1 or more). Give --jobs 1 or more.",
                code="jobs_range",
            )
        if self.bench is not None and not (self.bench / TABLE).is_file():
            raise InvalidValueError(
                f"oracle: {self.bench} has no {TABLE}. Give the folder of a `./z1 bench` run.", code="no_bench_table"
            )


def main(config: Config) -> int:
    """Search the missing scenarios, and write summary and report."""
    search = replace(OracleConfig(), executions=config.executions)
    store = Store(config.out, config.resume)
    done = {scenario for scenario, _ in store.done()}
    scenarios = [s for s in grid(config.objects or OBJECT_SETS[config.set], config.seeds, (0.0,), config.clutter)]
    for name, chosen in (("pitch_deg", config.pitches), ("distance", config.distances), ("lateral", config.laterals)):
        scenarios = [s for s in scenarios if not chosen or getattr(s, name) in chosen]
    if not scenarios:
        raise InvalidValueError(
            f"oracle: no scenario is left (pitches {config.pitches}, allowed -45, 0 and 45; extended set: 0). "
            "Give others.",
            code="no_scenario",
        )
    tasks = [OracleTask(scenario=s, config=search) for s in scenarios if s.key not in done]
    console = Console(highlight=False)
    try:
        _run(tasks, config.jobs, store, console)
    finally:  # also after Ctrl-C: the rows of finished scenarios are kept
        if rows := store.rows():
            store.write_table()
            run = {"version": version("z1-grasp"), "command": plain(asdict(config)), "search": asdict(search)}
            summary = write_summary(rows, config.out / "summary.json", run, _load_bench_rows(config.bench))
            write_report(rows, summary, config.out / "report.html")
            _print_summary(console, summary)
            console.print(f"rows: {config.out}/episodes.parquet, figures: {config.out}/summary.json and report.html")
    return 0


def _run(tasks: list[OracleTask], jobs: int, store: Store, console: Console) -> None:
    before = store.rows(["success"])
    solved, searched = sum(bool(row["success"]) for row in before), len(before)
    if not tasks:
        return
    with make_progress(console) as progress:
        bar = progress.add_task(f"solved {solved} of {searched}", total=len(tasks))
        for rows in run_tasks(tasks, jobs, run_oracle_task):
            store.add(rows)
            searched += len(rows)
            solved += sum(bool(row["success"]) for row in rows)
            progress.update(bar, advance=1, description=f"solved {solved} of {searched}")


def _load_bench_rows(folder: Path | None) -> list[Row]:
    """Return the episodes of a benchmark's run."""
    if folder is None:
        return []
    import pyarrow.parquet as pq

    # The oracle is no method of its own comparison.
    return [row for row in pq.read_table(folder / TABLE).to_pylist() if row["method"] != METHOD]


def _print_summary(console: Console, summary: dict[str, Any]) -> None:
    table = Table("object", "scenarios", "solved")
    for name, counts in summary["by"]["object"].items():
        table.add_row(name, str(counts["episodes"]), str(counts["solved"]))
    table.add_row("all", str(summary["episodes"]), str(summary["solved"]), style="bold")
    console.print(table)
    for item in summary["unsolved"]:
        modes = ", ".join(f"{mode} {n}" for mode, n in item["modes"].items())
        console.print(f"{item['scenario']}: {item['verdict']} after {item['executions']} executions ({modes or '–'})")
    for name, m in summary["methods"].items():
        console.print(f"{name}: {m['solved']} of {m['solvable']} that can be solved, {m['rate_of_solvable']:.1%}")


if __name__ == "__main__":
    sys.exit(cli.main(["oracle", *sys.argv[1:]]))
