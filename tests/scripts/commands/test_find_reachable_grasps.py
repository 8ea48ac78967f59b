import json

import pyarrow.parquet as pq
import pytest

from hal.base.errors import InvalidValueError, OutputExistsError
from scripts.commands import find_reachable_grasps
from scripts.commands.find_reachable_grasps import Config, main
from sim_twin.benchmark.episodes.execution import EpisodeRobot, Mode, Outcome
from tests.support.errors import raises


@pytest.fixture
def searched(monkeypatch):
    """Searches in this process, where every grasp misses; gives the number of searches."""
    count = []

    def run_tasks(tasks, jobs, run):
        assert jobs == 1
        for task in tasks:
            count.append(task)
            yield run(task)

    monkeypatch.setattr(find_reachable_grasps, "run_tasks", run_tasks)
    monkeypatch.setattr(EpisodeRobot, "execute", lambda *_: Outcome(mode=Mode.MISSED))
    return count


@pytest.mark.integration
def test_a_search_is_kept_and_gone_on_with(searched, tmp_path, capsys):
    place = {"objects": ("box",), "pitches": (0.0,), "distances": ("mid",), "laterals": ("left",)}
    config = Config(**place, executions=2, jobs=1, out=tmp_path)
    assert main(config) == 0
    assert "box-mid-left-+0-s0: unsolved after 2 executions (missed 2)" in capsys.readouterr().out
    (row,) = pq.read_table(tmp_path / "episodes.parquet").to_pylist()
    assert row["modes"] == ["missed", "missed"]
    assert json.loads((tmp_path / "summary.json").read_text())["solved"] == 0
    assert "unsolved" in (tmp_path / "report.html").read_text()
    with raises(OutputExistsError, "output_exists"):
        main(config)
    assert main(Config(**place, executions=2, jobs=1, out=tmp_path, resume=True, bench=tmp_path)) == 0
    assert len(searched) == 1


def test_invalid_options_are_rejected(tmp_path):
    with raises(InvalidValueError, "jobs_range"):
        Config(jobs=0)
    with raises(InvalidValueError, "no_bench_table"):
        Config(bench=tmp_path)
    with raises(InvalidValueError, "no_scenario"):
        main(Config(objects=("mug",), pitches=(45.0,), out=tmp_path))
