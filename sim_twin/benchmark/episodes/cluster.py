"""Scenarios on an existing Ray cluster; the rows equal those of a local run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import Any

from hal.base.errors import Z1Error
from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.runner import SINGLE_THREAD_ENV, Task, limit_threads, run_task

_ROOMS = ("hal", "models", "calibration", "z1_runtime", "sim_twin")
_ROOT = Path(__file__).parents[3]
_AHEAD = 2
"""Tasks that wait for each of the cluster's cores."""


class NoRayError(Z1Error, RuntimeError):
    """The package `ray` is not installed."""

    default_code = "ray_missing"


class ClusterError(Z1Error, RuntimeError):
    """The cluster cannot be reached or has no free core."""

    default_code = "cluster"


def run_tasks_on_ray(tasks: Sequence[Task], address: str) -> Iterator[list[Row]]:
    """Yield the rows of each task as it ends, in any order.

    The cluster's machines need the locked environment, and Ray and Python in the versions of this one; the project's
    own code travels with the run.

    Args:
        tasks: without recordings, which would stay on the cluster's machines.
        address: of the cluster: `auto`, `HOST:6379` from one of its machines, `ray://HOST:10001` from elsewhere.

    Raises:
        NoRayError: the extra `ray` is not installed.
        ClusterError: no cluster answers at `address`.
    """
    ray = _import_ray()
    try:
        ray.init(address=address, runtime_env=_worker_environment(), log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
        raise ClusterError(
            f"cluster: no Ray cluster answers at {address!r} ({error}). Start one with `ray start --head`, and give "
            "its HOST:6379, or ray://HOST:10001 from a machine that is no part of it.",
            code="cluster_unreachable",
        ) from error
    try:
        cores = int(ray.cluster_resources().get("CPU", 0))
        if not cores:
            raise ClusterError(
                f"cluster: {address!r} has no CPU ({ray.cluster_resources()}, allowed 1 or more). Add a machine to it.",
                code="cluster_no_cpu",
            )
        yield from _iterate_completed(ray, tasks, _AHEAD * cores)
    finally:
        ray.shutdown()


def _iterate_completed(ray: Any, tasks: Sequence[Task], ahead: int) -> Iterator[list[Row]]:
    # One core a task, as each worker is limited to one thread
    remote = ray.remote(num_cpus=1)(_run_on_worker)
    waiting = iter(tasks)
    running = [remote.remote(task) for task in islice(waiting, ahead)]
    while running:
        ended, running = ray.wait(running)
        running += [remote.remote(task) for task in islice(waiting, len(ended))]
        yield from ray.get(ended)


def _run_on_worker(task: Task) -> list[Row]:
    limit_threads()
    return run_task(task)


def _worker_environment() -> dict[str, Any]:
    return {
        "py_modules": [str(_ROOT / room) for room in _ROOMS],
        "excludes": ["**/__pycache__"],
        "env_vars": dict(SINGLE_THREAD_ENV),
    }


def _import_ray() -> ModuleType:
    try:
        import ray  # pyright: ignore[reportMissingImports] (an extra)
    except ImportError as error:
        raise NoRayError(
            "cluster: the package ray is not installed (extra `ray`). Run uv sync --inexact --extra ray, and "
            "this again."
        ) from error
    return ray
