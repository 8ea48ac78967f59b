"""Fit the ranking's numbers to logged episodes; keep the hand-set ones unless the fitted win on held-out seeds.

./z1 bench --generator diffusion --seeds 1 --methods mvb mvb:k=1 mvb:k=3 mvb:alpha=0.5 mvb:alpha=1 full --out out/log
./z1 tune out/log                                # fits to seed 1, runs the proposals on seed 2, writes out/tune
./z1 tune out/log --held-out 2 3 --reading fallthrough
./z1 tune out/log out/log2 --no-run              # evaluates on the logged rows alone
./z1 bench --methods mvb:scoring=out/tune/scoring.yaml full:scoring=out/tune/scoring.yaml

The runtime ranks by the file that `scoring` names in its configuration (see `./z1 show-config`).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro
from rich.console import Console
from rich.table import Table

from hal.base.errors import InvalidValueError
from hal.base.files import atomic_write
from hal.base.output_folder import open_output
from scripts.support.progress import make_progress

if TYPE_CHECKING:
    from sim_twin.benchmark.episodes.methods import Method
    from sim_twin.benchmark.episodes.rows import Row
    from sim_twin.benchmark.episodes.scenarios import Scenario
    from sim_twin.benchmark.report.tables import Table as TextTable
    from sim_twin.benchmark.tuning.fit import Tuning
    from z1_runtime.config import RuntimeConfig


@dataclass(frozen=True, kw_only=True)
class Config:
    """Options of the tuning."""

    logs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of `./z1 bench` runs under the same settings, with `mvb` or `full` and variants of them."""
    held_out: tuple[int, ...] = ()
    """Seeds on which proposals are evaluated and to which nothing is fitted; by default the last of several seeds in
    the rows, or the one after a single seed."""
    reading: Literal["top1", "fallthrough"] = "top1"
    """Definition of success: the first-ranked grasp alone, or the first reachable one. A proposal must win in this
    reading and lose at most 2 % in the other."""
    head: bool = True
    """Propose a scoring head too: a logistic regression on each grasp's features."""
    run: bool = True
    """Run the missing episodes on the held-out seeds; about 1.5 s of a core each."""
    jobs: int = 2
    """Worker processes."""
    resume: bool = False
    """Continue an interrupted run in the same folder."""
    out: Path = Path("out/tune")
    """Folder for scoring.yaml, report.html, tuning.json, proposals/ and the new episodes."""

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise InvalidValueError(
                f"tune: jobs is out of range ({self.jobs}, allowed 1 or more). Give --jobs 1 or more.",
                code="jobs_range",
            )
        if any(seed < 0 for seed in self.held_out):
            raise InvalidValueError(
                f"tune: a held-out seed is negative ({self.held_out}, allowed 0 or more). Give seeds of 0 or more.",
                code="held_out_range",
            )


def main(config: Config) -> int:
    """Fit, evaluate, and write the scoring, the report and the evidence."""
    with open_output(config.out):
        return _run(config)


def _run(config: Config) -> int:
    from sim_twin.benchmark.tuning.fit import tune
    from sim_twin.benchmark.tuning.folds import require_sklearn
    from sim_twin.benchmark.tuning.logged_episodes import load_logs
    from sim_twin.benchmark.tuning.report import write_tuning_report
    from z1_runtime.grasping.ranking import save_scoring

    require_sklearn()  # first: a missing package is reported before the logs are read
    logs = load_logs(config.logs)
    console = Console(highlight=False)
    tuning = tune(
        logs,
        held_out_seeds=config.held_out or _default_held_out(logs.seeds),
        reading=config.reading,
        folder=config.out / "proposals",
        run=_make_runner(config, logs.config, console) if config.run else None,
        head=config.head,
    )
    save_scoring(tuning.scoring, config.out / "scoring.yaml")
    write_tuning_report(tuning, config.out / "report.html")
    evidence = json.dumps(dict(tuning.scoring.evidence), indent=1, ensure_ascii=False)
    atomic_write(config.out / "tuning.json", evidence + "\n")
    _print_tuning(console, tuning)
    console.print(f"scoring: {config.out}/scoring.yaml, report: {config.out}/report.html")
    return 0


def _default_held_out(seeds: Sequence[int]) -> tuple[int, ...]:
    return (seeds[-1],) if len(seeds) > 1 else (seeds[-1] + 1,)


def _make_runner(config: Config, runtime: RuntimeConfig, console: Console):
    """Return a `sim_twin.benchmark.tuning.fit.RunEpisodes` that stores its rows in `config.out`."""
    from sim_twin.benchmark.episodes import runner
    from sim_twin.benchmark.results.store import Store

    def run(methods: Sequence[Method], scenarios: Sequence[Scenario], done: set[tuple[str, str]]) -> list[Row]:
        store = Store(config.out, config.resume)
        tasks = runner.make_tasks(scenarios, methods, runtime, done | store.done())
        with make_progress(console, "held-out scenarios") as progress:
            bar = progress.add_task("", total=len(tasks))
            for rows in runner.run_tasks(tasks, config.jobs) if tasks else ():
                store.add(rows)
                progress.advance(bar)
        return store.rows()

    return run


def _print_tuning(console: Console, tuning: Tuning) -> None:
    from sim_twin.benchmark.tuning import report

    for name, family in tuning.families.items():
        variants = family.draft.variants
        table = report.tabulate_variants(name, family, tuning.reading)
        _print_table(console, table, f"{name}: fitted to seeds {_list(tuning.train_seeds)}")
        console.print(
            f"cross-validated choice of the variant: {variants.cross_validated} of {variants.scenarios} "
            f"({tuning.reading})"
        )
        _print_table(console, report.tabulate_thresholds(family.draft.thresholds))
        held_out = f"evaluated on seeds {_list(tuning.held_out_seeds)}"
        _print_table(console, report.tabulate_held_out(family), held_out)
    if tuning.head is not None:
        _print_table(console, report.tabulate_skill(tuning.head), "scoring head")
    console.print(tuning.head_note)
    for name, family in tuning.families.items():
        console.print(f"[bold]{name}[/bold]: {family.why}")


def _list(seeds: Sequence[int]) -> str:
    return ", ".join(map(str, seeds))


def _print_table(console: Console, content: TextTable, title: str = "") -> None:
    if content.rows:
        table = Table(*content.head, title=title)
        for row in content.rows:
            table.add_row(*row)
        console.print(table)
