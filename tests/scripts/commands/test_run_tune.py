"""`./z1 tune` from the folder of a run to the file that the runtime loads."""

import json
import sys

import pytest

from hal.base.errors import InvalidValueError, OutputExistsError
from scripts.cli import main as z1
from scripts.commands.run_tune import Config, _default_held_out, main
from sim_twin.benchmark.episodes import runner
from sim_twin.benchmark.episodes.scenarios import grid
from sim_twin.benchmark.tuning.folds import NoSklearnError
from tests.support.errors import raises
from z1_runtime.config import RuntimeConfig, ranking_of
from z1_runtime.grasping.ranking import load_scoring

pytest.importorskip("sklearn", reason="uv sync --inexact --extra tune")


def row(scenario, method, success):
    return {
        **scenario.columns(), "method": method, "version": "0", "attempts": 1, "rank": 0, "candidate": 1,
        "success": success, "success_top1": success, "alignment": 0.5, "generator_score": 0.5,
    }  # fmt: skip


@pytest.fixture
def log(tmp_path):
    """A run on seed 1 in which three faces lift everything and two lift a third."""
    from dataclasses import asdict

    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = [
        row(scenario, method, method.endswith("3") or n % 3 == 0)
        for n, scenario in enumerate(grid(seeds=(1,)))
        for method in ("mvb", "mvb:k=3", "full", "full:k=3")
    ]
    folder = tmp_path / "log"
    folder.mkdir()
    pq.write_table(pa.Table.from_pylist(rows), folder / "episodes.parquet")
    (folder / "summary.json").write_text(json.dumps({"run": {"settings": asdict(RuntimeConfig(seed=5))}}))
    return folder


def twin(lifts):
    """Return a fake runner: `lifts` maps a method and the scenario's number to success."""

    def run_tasks(tasks, jobs):
        assert {task.scenario.seed for task in tasks} == {2}
        assert {task.config.seed for task in tasks} == {5}
        return (
            [row(task.scenario, method.name, lifts(method, n)) for method in task.methods]
            for n, task in enumerate(tasks)
        )

    return run_tasks


@pytest.mark.integration
def test_fitted_values_that_win_are_written_and_loaded_by_the_runtime(log, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(runner, "run_tasks", twin(lambda method, n: method.k == 3 or n % 3 == 0))
    out = tmp_path / "tune"
    assert main(Config(logs=(log,), out=out)) == 0
    printed = capsys.readouterr().out
    assert "mvb: took k=3" in printed
    assert "No head was fitted" in printed
    scoring = load_scoring(out / "scoring.yaml")
    assert scoring.tuned == ("mvb", "full")
    assert scoring.evidence["evaluated_on_seeds"] == [2]
    assert scoring.evidence["evaluated"]["mvb"][0]["top1"]["tuned"] == 81
    assert ranking_of(RuntimeConfig(scoring=out / "scoring.yaml")).k_faces == 3
    assert json.loads((out / "tuning.json").read_text())["verdicts"]["full"].startswith("took k=3")
    assert "<svg" in (out / "report.html").read_text()

    with raises(OutputExistsError, "output_exists"):
        main(Config(logs=(log,), out=out))
    monkeypatch.setattr(runner, "run_tasks", lambda *_: pytest.fail("all of it has been run"))
    assert main(Config(logs=(log,), out=out, resume=True)) == 0


@pytest.mark.integration
def test_without_a_winner_the_hand_set_values_are_written(log, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(runner, "run_tasks", twin(lambda method, n: n % 3 == 0))
    assert z1(["tune", str(log), "--out", str(tmp_path / "tune")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "mvb: kept the hand-set values (k=2 α=0.85 box=pca) because on the held-out seeds" in printed
    scoring = load_scoring(tmp_path / "tune" / "scoring.yaml")
    assert scoring.tuned == ()
    assert (scoring.mvb.k_faces, scoring.full.k_faces) == (2, 2)
    assert scoring.full == ranking_of(RuntimeConfig())


@pytest.mark.integration
def test_nothing_is_run_when_that_is_forbidden(log, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(runner, "run_tasks", lambda *_: pytest.fail("--no-run was given"))
    assert z1(["tune", str(log), "--no-run", "--out", str(tmp_path / "tune")]) == 0
    assert "no proposal was run" in " ".join(capsys.readouterr().out.split())


def test_the_last_seed_is_held_out_or_the_one_after_the_only_one():
    assert _default_held_out((0, 3, 5)) == (5,)
    assert _default_held_out((4,)) == (5,)


def test_bad_calls_give_one_line(tmp_path, capsys):
    assert z1(["tune", str(tmp_path / "nowhere"), "--out", str(tmp_path)]) == 2
    assert "Give the --out of a `./z1 bench`" in capsys.readouterr().err
    with raises(InvalidValueError, "jobs_range"):
        Config(logs=(), jobs=0)
    with raises(InvalidValueError, "held_out_range"):
        Config(logs=(), held_out=(-1,))


def test_without_scikit_learn_the_error_has_its_own_code(log, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn", None)
    with raises(NoSklearnError, "sklearn_missing"):
        main(Config(logs=(log,), out=tmp_path / "tune"))
