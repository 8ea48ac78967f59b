from dataclasses import replace

import numpy as np
import pytest

from sim_twin.benchmark.episodes.episode import run_scenario
from sim_twin.benchmark.episodes.execution import EpisodeRobot, Mode, capture
from sim_twin.benchmark.episodes.methods import METHODS
from sim_twin.benchmark.episodes.runner import make_tasks, run_task
from sim_twin.benchmark.episodes.scenarios import Scenario
from sim_twin.model.scene import SceneConfig
from z1_runtime.config import RuntimeConfig
from z1_runtime.factory import make_grasp_selector
from z1_runtime.grasping.ranking import FEATURES

pytestmark = pytest.mark.integration

CONFIG = RuntimeConfig(generator="antipodal", detector="tabletop", n_candidates=400)
SCENARIO = Scenario(object="cylinder", distance="mid", lateral="centre", pitch_deg=0.0)


@pytest.fixture(scope="module")
def selector():
    return make_grasp_selector(CONFIG)


@pytest.fixture(scope="module")
def rows(selector):
    return run_scenario(SCENARIO, list(METHODS.values()), lambda *_: selector)


def test_every_method_has_a_row_from_the_same_candidates(rows):
    assert [row["method"] for row in rows] == list(METHODS)
    assert len({row["n_candidates"] for row in rows}) == 1
    assert rows[0]["n_free"] == rows[1]["n_free"] < rows[0]["n_candidates"]


def test_an_upright_cylinder_is_lifted_and_held_still(rows):
    full = rows[-1]
    assert full["mode"] == "success", full["detail"]
    assert full["lifted_m"] > 0.08
    assert full["slip_m"] < 0.02
    assert full["jaws_touching"] == 2
    assert full["final_qpos"][9] > 0.15  # the object's height: its middle stood at 75 mm


def test_a_row_says_which_candidate_was_taken_and_why(rows):
    mvb = rows[1]
    assert 0.0 < mvb["alignment"] <= 1.0
    assert len(mvb["faces"]) == 2
    assert len(mvb["face_normals"]) == 6
    assert mvb["success_top1"] == (mvb["success"] and mvb["rank"] == 0)


def test_a_row_holds_what_a_scoring_head_is_fitted_to(rows, selector):
    for row in rows:
        grasp, first = ([row[f"{which}_{name}"] for name in FEATURES] for which in ("grasp", "first"))
        assert np.isfinite(grasp).all()
        assert (grasp == first) == (row["rank"] == 0)
        assert row["grasp_generator"] == row["generator_score"]
        assert row["grasp_down"] == pytest.approx(-np.reshape(row["T_base_grasp"], (4, 4))[2, 2], abs=0.03)
    assert rows[1]["first_candidate"] == rows[1]["candidate"] or rows[1]["rank"] > 0


def test_an_object_that_is_not_where_it_was_seen_is_not_called_lifted(selector):
    frame, q = capture(SCENARIO.scene())
    plan = selector.select(frame, q).plan
    elsewhere = SceneConfig(object="cylinder", distance_m=0.60, lateral_m=0.20)
    with EpisodeRobot(elsewhere, selector.kinematics) as robot:
        outcome = robot.execute(plan)
    assert outcome.mode is Mode.MISSED
    assert outcome.lifted_m < 0.01


def test_an_object_that_cannot_be_seen_is_a_row_too(selector):
    hidden = replace(SCENARIO, occlusion=0.99)
    (row,) = run_scenario(hidden, [METHODS["mvb"]], lambda *_: selector)
    assert row["mode"] == "no detection"
    assert row["detail"]
    assert not row["success"]


def test_what_is_done_is_not_done_again():
    methods = [METHODS["vanilla"], METHODS["mvb"]]
    (task,) = make_tasks([SCENARIO], methods, CONFIG, {(SCENARIO.key, "mvb")})
    assert [method.name for method in task.methods] == ["vanilla"]
    assert make_tasks([SCENARIO], methods, CONFIG, {(SCENARIO.key, m.name) for m in methods}) == []


@pytest.mark.slow
def test_the_same_task_gives_the_same_row():
    (task,) = make_tasks([SCENARIO], [METHODS["mvb"]], CONFIG, set())
    first, second = ({k: v for k, v in run_task(task)[0].items() if not k.endswith("_ms")} for _ in range(2))
    assert first == second
