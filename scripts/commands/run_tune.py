"""Fits the ranking's numbers to logged episodes, and keeps those set by hand unless the fitted ones win on new seeds.

./z1 bench --generator diffusion --seeds 1 --methods mvb mvb:k=1 mvb:k=3 mvb:alpha=0.5 mvb:alpha=1 full --out out/log
./z1 tune out/log                                # fits to seed 1, runs what is proposed on seed 2, writes out/tune
./z1 tune out/log --held-out 2 3 --reading fallthrough
./z1 tune out/log out/log2 --no-run              # judges by the rows that are there alone
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
from scripts.support.progress import make_progress

if TYPE_CHECKING:
    from sim_twin.benchmark.episodes.methods import Method
    from sim_twin.benchmark.episodes.rows import Row
    from sim_twin.benchmark.episodes.scenarios import Scenario
    from sim_twin.benchmark.tuning.fit import Tuning
    from z1_runtime.config import RuntimeConfig


@dataclass(frozen=True, kw_only=True)
class Config:
    """What is fitted to what, and by which episodes it is judged."""

    logs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of `./z1 bench` runs under the same settings, with `mvb` or `full` and variants of them."""
    held_out: tuple[int, ...] = ()
    """Seeds by which proposals are judged and to which nothing is fitted. If none are given: the last of several seeds
    in the rows, or the one after a single one."""
    reading: Literal["top1", "fallthrough"] = "top1"
    """What counts as a success: the first-ranked grasp alone, or the first that the arm can do. A proposal must win in
    this and lose no more than 2 % in the other."""
    head: bool = True
    """Propose a scoring head too: a logistic regression on what is measured of each grasp."""
    run: bool = True
    """Run the episodes that are missing on the held-out seeds; some 1.5 s of a core each."""
    jobs: int = 2
    """Episodes side by side, a process each."""
    resume: bool = False
    """Go on with an interrupted run in the same folder."""
    out: Path = Path("out/tune")
    """Folder for scoring.yaml, report.html, tuning.json, proposals/ and the episodes that were run."""

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise InvalidValueError(f"jobs is {self.jobs}; allowed is 1 or more.")
        if any(seed < 0 for seed in self.held_out):
            raise InvalidValueError(f"held-out is {self.held_out}; allowed are seeds of 0 or more.")


def main(config: Config) -> int:
    """Fit, judge, write, and say what was kept."""
    from sim_twin.benchmark.tuning.fit import tune
    from sim_twin.benchmark.tuning.folds import require_sklearn
    from sim_twin.benchmark.tuning.logged_episodes import load_logs
    from sim_twin.benchmark.tuning.report import write_tuning_report
    from z1_runtime.grasping.ranking import save_scoring

    require_sklearn()
    logs = load_logs(config.logs)
    console = Console(highlight=False)
    tuning = tune(
        logs,
        held_out_seeds=config.held_out or _held_out(logs.seeds),
        reading=config.reading,
        folder=config.out / "proposals",
        run=_runner(config, logs.config, console) if config.run else None,
        head=config.head,
    )
    config.out.mkdir(parents=True, exist_ok=True)
    save_scoring(tuning.scoring, config.out / "scoring.yaml")
    write_tuning_report(tuning, config.out / "report.html")
    evidence = json.dumps(dict(tuning.scoring.evidence), indent=1, ensure_ascii=False)
    (config.out / "tuning.json").write_text(evidence + "\n", encoding="utf-8")
    _print(console, tuning)
    console.print(f"scoring: {config.out}/scoring.yaml, report: {config.out}/report.html")
    return 0


def _held_out(seeds: Sequence[int]) -> tuple[int, ...]:
    return (seeds[-1],) if len(seeds) > 1 else (seeds[-1] + 1,)


def _runner(config: Config, runtime: RuntimeConfig, console: Console):
    """Return what runs episodes into `config.out`, as `sim_twin.benchmark.tuning.fit.RunEpisodes`."""
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


def _print(console: Console, tuning: Tuning) -> None:
    from sim_twin.benchmark.tuning.report import (
        HELD_OUT_HEADER,
        SKILL_HEADER,
        THRESHOLD_HEADER,
        held_out_rows,
        skill_row,
        threshold_row,
    )
    from sim_twin.benchmark.tuning.variants import format_ranking

    for name, family in tuning.families.items():
        variants = family.draft.variants
        table = Table(
            f"{name}: variant", "numbers", *variants.successes, title=f"fitted to seeds {_words(tuning.train_seeds)}"
        )
        for text in variants.names:
            own = [f"{count[text]} of {variants.scenarios}" for count in variants.successes.values()]
            table.add_row(text, format_ranking(family.draft.rankings[text]), *own)
        console.print(table)
        console.print(
            f"chosen without the scenarios it is judged on: {variants.cross_validated} of {variants.scenarios} "
            f"({tuning.reading})"
        )
        _print_table(console, THRESHOLD_HEADER, [threshold_row(*item) for item in family.draft.thresholds.items()])
        _print_table(
            console, HELD_OUT_HEADER, held_out_rows(family), f"judged on seeds {_words(tuning.held_out_seeds)}"
        )
    if tuning.head is not None:
        lines = [skill_row("other scenarios", tuning.head.skill)]
        lines += [skill_row(f"{name}, fitted to the others", skill) for name, skill in tuning.head.objects.items()]
        _print_table(console, SKILL_HEADER, lines, "scoring head")
    console.print(tuning.head_note)
    for name, family in tuning.families.items():
        console.print(f"[bold]{name}[/bold]: {family.why}")


def _words(seeds: Sequence[int]) -> str:
    return ", ".join(map(str, seeds))


def _print_table(console: Console, head: Sequence[str], lines: Sequence[Sequence[str]], title: str = "") -> None:
    if lines:
        table = Table(*head, title=title)
        for line in lines:
            table.add_row(*line)
        console.print(table)
