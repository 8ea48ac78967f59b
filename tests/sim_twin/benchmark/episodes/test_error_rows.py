import pytest

from sim_twin.benchmark.episodes import episode
from sim_twin.benchmark.episodes.episode import run_scenario
from sim_twin.benchmark.episodes.methods import METHODS
from sim_twin.benchmark.episodes.rows import TRACEBACK
from sim_twin.benchmark.episodes.runner import make_tasks, run_tasks
from sim_twin.benchmark.episodes.scenarios import Scenario
from sim_twin.benchmark.results.store import ERROR_LOG, Store
from sim_twin.benchmark.results.summary import summarise
from tests.support.failing_method import FAILING, InjectedError
from z1_runtime.config import RuntimeConfig
from z1_runtime.factory import make_grasp_selector

CONFIG = RuntimeConfig(generator="antipodal", detector="tabletop", n_candidates=200)
SCENARIOS = [
    Scenario(object="cylinder", distance="mid", lateral=lateral, pitch_deg=0.0) for lateral in ("centre", "left")
]


@pytest.fixture(scope="module")
def selector():
    return make_grasp_selector(CONFIG)


@pytest.mark.integration
def test_an_exception_becomes_the_row_of_its_method_alone(selector, monkeypatch):
    def run_method(_, method, *__, **___):
        if method.name == "mvb":
            raise InjectedError("no plan")
        return {"method": method.name}

    monkeypatch.setattr(episode, "_run_method", run_method)
    vanilla, mvb = run_scenario(SCENARIOS[0], [METHODS["vanilla"], METHODS["mvb"]], lambda *_: selector, top_k=2)
    assert vanilla == {"method": "vanilla"}
    assert (mvb["mode"], mvb["success"], mvb["success_after"]) == ("error", False, [False, False])
    assert (mvb["error_type"], mvb["detail"]) == ("InjectedError", "no plan")
    assert "in run_method" in mvb[TRACEBACK]


def test_an_exception_before_the_methods_becomes_the_row_of_each(selector, monkeypatch):
    def capture(_):
        raise InjectedError("no frame")

    monkeypatch.setattr(episode, "capture", capture)
    rows = run_scenario(SCENARIOS[0], list(METHODS.values()), lambda *_: selector)
    assert [(row["method"], row["mode"], row["error_type"]) for row in rows] == [
        (name, "error", "InjectedError") for name in METHODS
    ]


@pytest.mark.integration
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_run_goes_on_after_an_exception_in_a_worker(jobs, tmp_path):
    tasks = make_tasks(SCENARIOS, [FAILING], CONFIG, set())
    tasks[1] = make_tasks(SCENARIOS[1:], [METHODS["vanilla"]], CONFIG, set())[0]
    store = Store(tmp_path, resume=False)
    for rows in run_tasks(tasks, jobs):
        store.add(rows)
    centre, left = store.rows()
    assert (centre["mode"], centre["error_type"], centre["detail"]) == (
        "error",
        "InjectedError",
        "the ranking is broken",
    )
    assert left["mode"] != "error"
    assert TRACEBACK not in centre
    log = (tmp_path / ERROR_LOG).read_text()
    assert "failing_method.py" in log
    assert centre["scenario"] in log
    assert summarise(store.rows())["methods"]["vanilla"]["errors"] == 1
