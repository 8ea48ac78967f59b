"""Searches all grasps on the true object, in the true scene, by real physics: which scenarios can be solved at all.

./z1 oracle                              # the paper's 81; some minutes on two cores
./z1 oracle --set extended --out out/oracle_extended
./z1 oracle --objects bottle --pitches -45 --executions 100
./z1 oracle --resume --bench out/bench   # and what the methods make of it
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
from scripts import cli
from scripts.support.progress import make_progress
from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.runner import run_tasks
from sim_twin.benchmark.episodes.scenarios import OBJECT_SETS, grid
from sim_twin.benchmark.oracle.report import write_report, write_summary
from sim_twin.benchmark.oracle.search import METHOD, OracleConfig, OracleTask, run_oracle_task
from sim_twin.benchmark.results.store import TABLE, Store
from sim_twin.benchmark.results.summary import plain


@dataclass(frozen=True, kw_only=True)
class Config:
    """Which scenarios, and how long to look."""

    set: Literal["paper", "extended"] = "paper"
    """The paper's objects in 27 poses each, or the further ones, upright, in 9."""
    objects: tuple[str, ...] = ()
    """What stands on the table, if not all objects of the set."""
    pitches: tuple[float, ...] = ()
    """Leans, if not all of them [°]."""
    distances: tuple[str, ...] = ()
    """near, mid, far: those, if not all of them."""
    laterals: tuple[str, ...] = ()
    """left, centre, right: those, if not all of them."""
    clutter: tuple[int, ...] = (0,)
    """Numbers of neighbours, 0 to 3, that stand around the object."""
    seeds: tuple[int, ...] = (0,)
    """Of the neighbours; without them all seeds are the same scene."""
    executions: int = 40
    """Grasps executed, as unlike each other as can be, before a scenario counts as not solved."""
    jobs: int = 2
    """Scenarios side by side, a process each."""
    resume: bool = False
    """Go on with an interrupted run in the same folder."""
    bench: Path | None = None
    """Folder of a benchmark's run: what its methods make of the scenarios that can be solved."""
    out: Path = Path("out/oracle")
    """Folder for episodes/, episodes.parquet, summary.json and report.html."""

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise InvalidValueError(f"jobs is {self.jobs}; allowed is 1 or more.")
        if self.bench is not None and not (self.bench / TABLE).is_file():
            raise InvalidValueError(f"{self.bench} holds no {TABLE}; give the folder of a `./z1 bench` run.")


def main(config: Config) -> int:
    """Search what is missing, and say what can be solved."""
    search = replace(OracleConfig(), executions=config.executions)
    store = Store(config.out, config.resume)
    done = {scenario for scenario, _ in store.done()}
    scenarios = [s for s in grid(config.objects or OBJECT_SETS[config.set], config.seeds, (0.0,), config.clutter)]
    for name, chosen in (("pitch_deg", config.pitches), ("distance", config.distances), ("lateral", config.laterals)):
        scenarios = [s for s in scenarios if not chosen or getattr(s, name) in chosen]
    if not scenarios:
        raise InvalidValueError("no scenario is left; pitches are -45, 0 and 45 (0 alone for the extended set).")
    tasks = [OracleTask(scenario=s, config=search) for s in scenarios if s.key not in done]
    console = Console(highlight=False)
    try:
        _run(tasks, config.jobs, store, console)
    finally:
        if rows := store.rows():
            store.write_table()
            run = {"version": version("z1-grasp"), "command": plain(asdict(config)), "search": asdict(search)}
            summary = write_summary(rows, config.out / "summary.json", run, _others(config.bench))
            write_report(rows, summary, config.out / "report.html")
            _print(console, summary)
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


def _others(folder: Path | None) -> list[Row]:
    """Return the episodes of a benchmark's run."""
    if folder is None:
        return []
    import pyarrow.parquet as pq

    return [row for row in pq.read_table(folder / TABLE).to_pylist() if row["method"] != METHOD]


def _print(console: Console, summary: dict[str, Any]) -> None:
    table = Table("object", "scenarios", "solved")
    for name, tally in summary["by"]["object"].items():
        table.add_row(name, str(tally["episodes"]), str(tally["solved"]))
    table.add_row("all", str(summary["episodes"]), str(summary["solved"]), style="bold")
    console.print(table)
    for item in summary["unsolved"]:
        modes = ", ".join(f"{mode} {n}" for mode, n in item["modes"].items())
        console.print(f"{item['scenario']}: {item['verdict']} after {item['executions']} executions ({modes or '–'})")
    for name, m in summary["methods"].items():
        console.print(f"{name}: {m['solved']} of {m['solvable']} that can be solved, {m['rate_of_solvable']:.1%}")


if __name__ == "__main__":
    sys.exit(cli.main(["oracle", *sys.argv[1:]]))
