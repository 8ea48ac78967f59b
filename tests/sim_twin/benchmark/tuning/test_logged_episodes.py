import json
from dataclasses import replace

import pytest

from hal.base.errors import ConfigError
from sim_twin.benchmark.tuning.logged_episodes import (
    TuneError,
    collect_outcomes,
    extract_samples,
    labelled_grasps,
    load_logs,
    scenario_pose,
)
from tests.support.errors import raises
from tests.support.tune_episodes import episode, scenarios, write_run
from z1_runtime.config import RuntimeConfig

HERE, THERE = scenarios(1)[:2]


def predictions(rows, reading):
    return [(row["method"], which, success) for row, which, success in labelled_grasps(rows, reading)]


def test_a_grasp_that_was_passed_over_failed_only_where_the_first_alone_counts():
    rows = [episode(HERE, "mvb", True, candidate=7, rank=3)]
    assert predictions(rows, "top1") == [("mvb", "first", False), ("mvb", "grasp", True)]
    assert predictions(rows, "fallthrough") == [("mvb", "grasp", True)]


def test_methods_that_chose_the_same_grasp_tell_of_it_once():
    same = [episode(HERE, "mvb", True, candidate=7), episode(HERE, "full", True, candidate=7)]
    assert predictions(same, "top1") == [("mvb", "grasp", True)]
    assert len(predictions([*same, episode(THERE, "full", True, candidate=7)], "top1")) == 2


def test_an_episode_without_a_plan_yields_its_first_grasp_alone():
    row = episode(HERE, "mvb", False, rank=3) | {"rank": None, "candidate": None}
    assert predictions([row], "top1") == [("mvb", "first", False)]
    assert predictions([row], "fallthrough") == []


def test_rows_with_retries_count_by_their_first_attempt_and_teach_nothing_of_grasps():
    row = episode(HERE, "mvb", True, attempts=2, success_after=[False, True])
    assert collect_outcomes([row], "fallthrough") == {"mvb": {HERE.key: False}}
    assert predictions([row], "fallthrough") == []


def test_rows_of_an_earlier_version_have_no_features_and_are_passed_over():
    row = {name: value for name, value in episode(HERE, "mvb", True).items() if not name.startswith("grasp_")}
    assert len(extract_samples([row, episode(THERE, "mvb", False)], "top1")) == 1


def test_the_same_pose_under_two_seeds_is_one_pose():
    (one, *_), (two, *_) = scenarios(1), scenarios(2)
    assert scenario_pose(one.columns()) == scenario_pose(two.columns()) != scenario_pose(THERE.columns())


def test_runs_are_read_together_each_episode_once(tmp_path):
    first = write_run(tmp_path / "a", [episode(HERE, "mvb", True)])
    second = write_run(tmp_path / "b", [episode(HERE, "mvb", True), episode(HERE, "full", False)])
    logs = load_logs([first, second])
    assert [row["method"] for row in logs.rows] == ["full", "mvb"]
    assert logs.config == RuntimeConfig()
    assert logs.seeds == (1,)


def test_unusable_runs_are_rejected(tmp_path):
    good = write_run(tmp_path / "good", [episode(HERE, "mvb", True)])
    other = write_run(tmp_path / "other", [episode(HERE, "mvb", True)], replace(RuntimeConfig(), n_candidates=7))
    with raises(TuneError, "different_settings"):
        load_logs([good, other])
    with raises(TuneError, "no_logs"):
        load_logs([])
    with raises(TuneError, "no_settings"):
        load_logs([tmp_path / "nowhere"])
    (good / "summary.json").write_text(json.dumps({"run": {"settings": {"sped": 1}}}))
    with pytest.raises(ConfigError):
        load_logs([good])
    (other / "episodes.parquet").unlink()
    with raises(TuneError, "no_episodes"):
        load_logs([other])
