import json

import pyarrow.parquet as pq
import pytest
import trimesh

from hal.base.errors import InvalidValueError, OutputExistsError
from scripts.commands import run_benchmark
from scripts.commands.run_benchmark import Config, main
from sim_twin.benchmark.episodes import runner, scenarios
from sim_twin.benchmark.episodes.execution import EpisodeRobot, Mode, Outcome
from sim_twin.benchmark.episodes.runner import run_task
from tests.support.errors import raises
from tests.support.failing_method import InjectedError


@pytest.fixture
def short(monkeypatch, tmp_path):
    """Runs the first pose of a grid, in this process, with rays, at a small size; every grasp misses."""
    whole = scenarios.grid
    monkeypatch.setattr(scenarios, "grid", lambda *args, **kwargs: whole(*args, **kwargs)[10:11])
    monkeypatch.setattr(runner, "run_tasks", lambda tasks, jobs: map(run_task, tasks))
    monkeypatch.setattr(EpisodeRobot, "execute", lambda *_: Outcome(mode=Mode.MISSED))
    monkeypatch.setattr("sim_twin.benchmark.report.pictures._SIZE", (320, 180))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.mark.integration
def test_a_run_of_a_users_mesh_writes_all_that_it_says(short, tmp_path, capsys):
    trimesh.creation.cylinder(28.0, height=120.0, sections=24).export(tmp_path / "tin.stl")
    out = tmp_path / "out"
    config = Config(mesh=tmp_path / "tin.stl", scale=1e-3, methods=("mvb",), top_k=2, jobs=1, out=out)
    assert main(config) == 0
    (row,) = pq.read_table(out / "episodes.parquet").to_pylist()
    assert row["object"].startswith("tin-")
    assert row["modes"] == ["missed", "missed"]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["methods"]["mvb"]["rate_after"] == [0.0, 0.0]
    assert summary["run"]["command"]["scale"] == 1e-3
    (picture,) = (out / "pictures").iterdir()
    (recording,) = (out / "recordings").iterdir()
    assert picture.stem == recording.stem == f"{row['scenario']}-mvb"
    page = (out / "report.html").read_text()
    assert f'href="recordings/{row["scenario"].replace("+", "%2B")}-mvb.rrd"' in page
    assert "within 2" in capsys.readouterr().out

    with raises(OutputExistsError, "output_exists"):
        main(config)
    before = recording.stat().st_mtime_ns
    assert main(Config(**{**vars(config), "resume": True})) == 0
    assert recording.stat().st_mtime_ns == before


@pytest.mark.integration
def test_an_exception_in_an_episode_is_counted_and_sets_the_exit_code(short, tmp_path, monkeypatch, capsys):
    def execute(*_):
        raise InjectedError("the gripper is beyond its limit")

    monkeypatch.setattr(EpisodeRobot, "execute", execute)
    out = tmp_path / "out"
    config = Config(objects=("cylinder",), methods=("mvb",), jobs=1, out=out)
    assert main(config) == 1
    (row,) = pq.read_table(out / "episodes.parquet").to_pylist()
    assert (row["mode"], row["detail"]) == ("error", "the gripper is beyond its limit")
    assert json.loads((out / "summary.json").read_text())["methods"]["mvb"]["errors"] == 1
    assert "InjectedError" in (out / "errors.log").read_text()
    assert "1 episodes ended in an exception" in capsys.readouterr().out
    assert main(Config(**{**vars(config), "resume": True})) == 1


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ({"jobs": 0}, "jobs_range"),
        ({"top_k": 0}, "top_k_range"),
        ({"ray": "auto", "recordings": "all"}, "recordings_on_cluster"),
    ],
)
def test_invalid_options_are_rejected(options, code):
    with raises(InvalidValueError, code):
        Config(**options)


def test_a_cluster_is_used_only_when_asked_for(monkeypatch):
    from sim_twin.benchmark.episodes import cluster

    monkeypatch.setattr(runner, "run_tasks", lambda tasks, jobs: ("local", jobs))
    monkeypatch.setattr(cluster, "run_tasks_on_ray", lambda tasks, address: ("ray", address))
    assert run_benchmark._rows_of([object()], Config(jobs=3)) == ("local", 3)
    assert run_benchmark._rows_of([object()], Config(ray="auto")) == ("ray", "auto")
    assert list(run_benchmark._rows_of([], Config(ray="auto"))) == []
