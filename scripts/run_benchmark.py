"""Runs the paper's 81 scenarios in the twin: the same candidates for every method, one row an episode.

./z1 bench                                       # vanilla, mvb and full on all 81; some minutes on two cores
./z1 bench --methods full --objects box --seeds 0 1 2 --out out/boxes
./z1 bench --methods mvb mvb:k=3 mvb:alpha=0.5,box=upright --resume
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

if TYPE_CHECKING:
    from sim_twin.bench.runner import Task
    from sim_twin.bench.store import Store


@dataclass(frozen=True, kw_only=True)
class Config:
    """Which episodes, and how many at a time."""

    methods: tuple[str, ...] = ("vanilla", "mvb", "full")
    """vanilla, mvb and full; a setting can be changed, as in `mvb:k=3,alpha=0.5,box=upright,hard_filter=no`."""
    set: Literal["paper", "extended"] = "paper"
    """The paper's objects in 27 poses each, or the further ones, upright, in 9."""
    objects: tuple[str, ...] = ()
    """What stands on the table, if not all objects of the set."""
    occlusion: tuple[float, ...] = (0.0,)
    """Shares of the object hidden from the camera."""
    seeds: tuple[int, ...] = (0,)
    """Each seed runs all poses anew, with other noise and other candidates."""
    generator: str | None = None
    """Grasp generator; the configuration's if not given."""
    detector: str | None = None
    """Detector; the configuration's if not given."""
    config: Path | None = None
    """A YAML file of settings (see `./z1 show-config`)."""
    jobs: int = 2
    """Episodes side by side, a process each."""
    resume: bool = False
    """Go on with an interrupted run in the same folder."""
    pictures: Literal["failures", "all", "none"] = "none"
    """Final states to draw into pictures/: up to 12 failures, which the report shows too, or every episode's."""
    recordings: Literal["failures", "all", "none"] = "none"
    """Episodes to write into recordings/ for Rerun: what was seen, ranked and chosen; about 2 MB each."""
    out: Path = Path("out/bench")
    """Folder for episodes/, episodes.parquet, summary.json and report.html."""


def main(config: Config) -> int:
    """Run what is missing, and say how it went."""
    from sim_twin.bench.methods import parse_method
    from sim_twin.bench.pictures import draw_pictures
    from sim_twin.bench.recordings import Recordings
    from sim_twin.bench.report import write_report
    from sim_twin.bench.runner import make_tasks
    from sim_twin.bench.scenarios import OBJECT_SETS, grid
    from sim_twin.bench.store import Store
    from sim_twin.bench.summary import write_summary
    from z1_runtime.config import load_config

    if config.jobs < 1:
        raise ValueError(f"jobs is {config.jobs}; allowed is 1 or more.")
    methods = [parse_method(text) for text in config.methods]
    scenarios = grid(config.objects or OBJECT_SETS[config.set], config.seeds, config.occlusion)
    changes = {"generator": config.generator, "detector": config.detector}
    runtime = replace(load_config(config.config), **{key: value for key, value in changes.items() if value})
    store = Store(config.out, config.resume)
    folder = config.out / "recordings"
    recordings = None if config.recordings == "none" else Recordings(folder=folder, choice=config.recordings)
    tasks = make_tasks(scenarios, methods, runtime, store.done(), recordings)
    console = Console(highlight=False)
    report = config.out / "report.html"
    rows, summary = [], {}
    try:
        _run(tasks, config.jobs, store, console)
    finally:
        rows = store.rows()
        if rows:
            store.write_table()
            run = {"version": version("z1-grasp"), "command": _plain(asdict(config)), "settings": asdict(runtime)}
            summary = write_summary(rows, config.out / "summary.json", _plain(run))
            write_report(rows, summary, report)
            _print(console, summary)
    pictures = draw_pictures(rows, config.pictures, config.out / "pictures")
    if pictures:
        write_report(rows, summary, report, pictures)
    console.print(f"rows: {config.out}/episodes.parquet, figures: {config.out}/summary.json and report.html")
    return 0


def _run(tasks: list[Task], jobs: int, store: Store, console: Console) -> None:
    from sim_twin.bench.runner import run_tasks

    tally = {row["method"]: [0, 0] for row in store.rows(["method"])}
    for row in store.rows(["method", "success"]):
        tally[row["method"]][0] += row["success"]
        tally[row["method"]][1] += 1
    columns = (
        TextColumn("scenarios"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("", total=len(tasks))
        for rows in run_tasks(tasks, jobs):
            store.add(rows)
            for row in rows:
                count = tally.setdefault(row["method"], [0, 0])
                count[0] += row["success"]
                count[1] += 1
            progress.update(bar, advance=1, description="  ".join(f"{m} {s}/{n}" for m, (s, n) in tally.items()))


def _print(console: Console, summary: dict[str, Any]) -> None:
    table = Table("method", "episodes", "success", "95 %", "first-ranked only", "95 %", "how the others ended")
    for name, method in summary["methods"].items():
        modes = ", ".join(f"{mode} {n}" for mode, n in method["modes"].items() if mode != "success")
        table.add_row(
            name,
            str(method["episodes"]),
            f"{method['rate']:.1%}",
            _interval(method["rate_95"]),
            f"{method['rate_top1']:.1%}",
            _interval(method["rate_top1_95"]),
            modes,
        )
    console.print(table)
    for pair in summary["paired"]:
        first, second = pair["methods"]
        console.print(
            f"{pair['reading']}: only {first} {pair['only_first']}, only {second} {pair['only_second']} of "
            f"{pair['scenarios']}, McNemar p = {pair['p']:.2g}"
        )


def _interval(interval: tuple[float, float]) -> str:
    return f"{interval[0]:.1%} to {interval[1]:.1%}"


def _plain(value: Any) -> Any:
    """Return `value` with paths as text, for JSON."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
