"""Runs scenarios side by side and keeps every row as it comes."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, ProcessPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice

from sim_twin.bench.episode import Row, run_scenario
from sim_twin.bench.methods import Method
from sim_twin.bench.recordings import Recordings
from sim_twin.bench.scenarios import Scenario
from z1_runtime.config import RuntimeConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One scenario for some methods."""

    scenario: Scenario
    methods: tuple[Method, ...]
    config: RuntimeConfig
    recordings: Recordings | None = None


def make_tasks(
    scenarios: Sequence[Scenario],
    methods: Sequence[Method],
    config: RuntimeConfig,
    done: set[tuple[str, str]],
    recordings: Recordings | None = None,
) -> list[Task]:
    """Return what is left to do: methods of a scenario that are done are left out."""
    tasks = []
    for scenario in scenarios:
        left = tuple(method for method in methods if (scenario.key, method.name) not in done)
        if left:
            tasks.append(Task(scenario=scenario, methods=left, config=config, recordings=recordings))
    return tasks


def run_task(task: Task) -> list[Row]:
    """Return the rows of one task; what it needs is built once in each process."""
    return run_scenario(task.scenario, task.methods, lambda seed: _decider(task.config, seed), task.recordings)


def run_tasks(tasks: Sequence[Task], jobs: int) -> Iterator[list[Row]]:
    """Yield the rows of each task as it ends, in any order; `jobs` processes share them.

    A row does not depend on `jobs`, nor on which process made it: each scenario has its own seeds.
    """
    if jobs == 1:
        yield from map(run_task, tasks)
        return
    # A fresh interpreter for each: forked ones would share OpenGL and torch with this one.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=_one_thread) as pool:
        yield from _in_order_of_ending(pool, tasks, 2 * jobs)


def _in_order_of_ending(pool: Executor, tasks: Sequence[Task], ahead: int) -> Iterator[list[Row]]:
    waiting = iter(tasks)
    running = {pool.submit(run_task, task) for task in islice(waiting, ahead)}
    while running:
        ended, running = wait(running, return_when=FIRST_COMPLETED)
        for future in ended:
            running |= {pool.submit(run_task, task) for task in islice(waiting, 1)}
            yield future.result()


def _one_thread() -> None:
    """Keep the maths libraries of a worker to one thread: the workers themselves fill the cores."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    import cv2

    cv2.setNumThreads(1)


def _decider(config: RuntimeConfig, seed: int):
    from z1_runtime.decision import Decider

    base = _assembled(replace(config, seed=0))
    return Decider(
        kinematics=base.kinematics,
        perception=base.perception,
        generator=base.generator,
        planner=base.planner,
        config=replace(config, seed=seed),
        T_flange_camera=base.T_flange_camera,
    )


@cache
def _assembled(config: RuntimeConfig):
    from z1_runtime.assembly import make_decider

    decider = make_decider(config)
    decider.warm_up()
    return decider
