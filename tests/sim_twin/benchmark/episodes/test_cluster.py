import importlib.util
import sys

import pytest

from sim_twin.benchmark.episodes.cluster import ClusterError, NoRayError, run_tasks_on_ray
from sim_twin.benchmark.episodes.methods import METHODS
from sim_twin.benchmark.episodes.runner import make_tasks, run_task
from sim_twin.benchmark.episodes.scenarios import Scenario
from tests.support.errors import raises
from z1_runtime.config import RuntimeConfig

TASKS = make_tasks(
    [Scenario(object="cylinder", distance="mid", lateral="centre", pitch_deg=0.0)],
    [METHODS["mvb"]],
    RuntimeConfig(n_candidates=200),
    set(),
)
needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="the extra `ray` is not installed")


def test_without_the_extra_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with raises(NoRayError, "ray_missing"):
        next(run_tasks_on_ray(TASKS, "auto"))


@needs_ray
def test_a_cluster_that_is_not_there_is_named(monkeypatch):
    import ray

    def init(**_):  # its own timeout is a minute and a half
        raise ConnectionError("no route")

    monkeypatch.setattr(ray, "init", init)
    with raises(ClusterError, "cluster_unreachable") as caught:
        next(run_tasks_on_ray(TASKS, "10.0.0.1:6379"))
    assert all(part in str(caught.value) for part in ("'10.0.0.1:6379'", "no route", "ray start --head"))


@needs_ray
@pytest.mark.integration
def test_the_rows_are_those_of_a_local_run():
    def plain(row):
        return {name: value for name, value in row.items() if not name.endswith("_ms")}

    ((row,),) = run_tasks_on_ray(TASKS, "local")
    assert plain(row) == plain(run_task(TASKS[0])[0])
