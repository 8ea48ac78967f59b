"""Scenarios in parallel worker processes; rows are yielded as they come."""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from typing import TYPE_CHECKING, TypeVar

from sim_twin.benchmark.episodes.episode import run_scenario
from sim_twin.benchmark.episodes.methods import Method
from sim_twin.benchmark.episodes.recordings import Recordings
from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.scenarios import Scenario
from sim_twin.benchmark.episodes.targeting import select_target
from z1_runtime.config import RuntimeConfig

if TYPE_CHECKING:
    from z1_runtime.tasks.grasp_selection import GraspSelector

T = TypeVar("T")

SINGLE_THREAD_ENV = {
    name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
}
"""Environment of a process limited to one core: the workers themselves fill the machine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One scenario for some methods."""

    scenario: Scenario
    methods: tuple[Method, ...]
    config: RuntimeConfig
    top_k: int = 1
    recordings: Recordings | None = None


def make_tasks(
    scenarios: Sequence[Scenario],
    methods: Sequence[Method],
    config: RuntimeConfig,
    done: set[tuple[str, str]],
    *,
    top_k: int = 1,
    recordings: Recordings | None = None,
) -> list[Task]:
    """Return the missing tasks: methods of a scenario with a row in `done` are left out."""
    tasks = []
    for scenario in scenarios:
        left = tuple(method for method in methods if (scenario.key, method.name) not in done)
        if left:
            tasks.append(Task(scenario=scenario, methods=left, config=config, top_k=top_k, recordings=recordings))
    return tasks


def run_task(task: Task) -> list[Row]:
    """Return the rows of one task; generator and detector are built once per process."""
    logging.getLogger("z1_runtime.tasks.grasp_selection").setLevel(
        logging.ERROR
    )  # warnings of wrong extrinsics are expected here: the benchmark varies them

    def selector(scenario: Scenario, seed: int) -> GraspSelector:
        return make_grasp_selector(task.config, scenario, seed)

    return run_scenario(task.scenario, task.methods, selector, top_k=task.top_k, recordings=task.recordings)


def run_tasks(tasks: Sequence[T], jobs: int, run: Callable[[T], list[Row]] = run_task) -> Iterator[list[Row]]:
    """Yield the rows of each task as it ends, in any order; `jobs` processes share them.

    A row does not depend on `jobs`, nor on which process made it: each scenario has its own seeds.

    Args:
        tasks: what `run` takes; they are sent to the processes.
        jobs: how many processes.
        run: does one task; a function of a module, which the processes import.
    """
    # A fresh interpreter for each: forked ones would inherit the state of OpenGL and torch.
    context = multiprocessing.get_context("spawn")
    jobs = min(jobs, max(len(tasks), 1))
    with (
        set_environment(SINGLE_THREAD_ENV),
        ProcessPoolExecutor(jobs, mp_context=context, initializer=limit_threads) as pool,
    ):
        # Two tasks a process: the next one is there when one ends
        yield from _iterate_completed(pool, tasks, 2 * jobs, run)


def _iterate_completed(
    pool: Executor, tasks: Sequence[T], ahead: int, run: Callable[[T], list[Row]]
) -> Iterator[list[Row]]:
    waiting = iter(tasks)
    running = {pool.submit(run, task) for task in islice(waiting, ahead)}
    while running:
        ended, running = wait(running, return_when=FIRST_COMPLETED)
        for future in ended:
            running |= {pool.submit(run, task) for task in islice(waiting, 1)}
            yield future.result()


@contextmanager
def set_environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables while the body runs: a child reads them before any of its code runs."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def limit_threads() -> None:
    """Limit OpenCV, which ignores the variables, to one thread."""
    import cv2

    cv2.setNumThreads(1)


def make_grasp_selector(config: RuntimeConfig, scenario: Scenario, seed: int) -> GraspSelector:
    """Return the runtime's grasp selector under `config` for the object of `scenario`, with the generator's `seed`."""
    from z1_runtime.perception.segmentation import Perception
    from z1_runtime.tasks.grasp_selection import GraspSelector

    # The cache's key is the configuration: one set of models for all seeds
    base = _assembled(replace(config, seed=0))
    config, detector = select_target(replace(config, seed=seed), base.perception.detector, scenario)
    perception = base.perception
    if detector is not perception.detector:
        perception = Perception(config.perception, detector, base.T_flange_camera)
    return GraspSelector(
        kinematics=base.kinematics,
        perception=perception,
        generator=base.generator,
        planner=base.planner,
        config=config,
        T_flange_camera=base.T_flange_camera,
    )


@cache
def _assembled(config: RuntimeConfig) -> GraspSelector:
    from z1_runtime.factory import make_grasp_selector, warm_up_selector

    selector = make_grasp_selector(config)
    warm_up_selector(selector)
    return selector
