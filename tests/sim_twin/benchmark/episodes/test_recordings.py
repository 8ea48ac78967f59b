from dataclasses import replace

import numpy as np
import pytest
from rerun.chunk import RrdReader

from models.types import GraspSet
from sim_twin.benchmark.episodes.episode import record_scenario, run_scenario
from sim_twin.benchmark.episodes.methods import METHODS as METHODS_OF_OURS
from sim_twin.benchmark.episodes.methods import parse_method
from sim_twin.benchmark.episodes.recordings import Recordings
from sim_twin.benchmark.episodes.scenarios import Scenario
from z1_runtime.config import RuntimeConfig
from z1_runtime.factory import make_grasp_selector
from z1_runtime.visualization import blueprint

SCENARIO = Scenario(object="cylinder", distance="mid", lateral="centre", pitch_deg=0.0)
METHODS = [parse_method("vanilla:collision_filter=no")]


@pytest.fixture(scope="module")
def selector():
    return make_grasp_selector(RuntimeConfig(generator="antipodal", detector="tabletop", n_candidates=400))


def entities(path):
    return {chunk.entity_path.strip("/") for chunk in RrdReader(path).stream().to_chunks()}


@pytest.mark.integration
def test_a_failure_is_recorded_with_what_was_seen_and_ranked(selector, tmp_path, monkeypatch):
    at_the_lens = GraspSet(T_camera_grasps=np.tile(np.eye(4), (3, 1, 1)), scores=np.ones(3), widths_m=np.full(3, 0.04))
    monkeypatch.setattr(type(selector), "generate", lambda self, observation: at_the_lens)
    recordings = Recordings(folder=tmp_path / "recordings", choice="failures")
    (row,) = run_scenario(SCENARIO, METHODS, lambda *_: selector, recordings=recordings)
    assert not row["success"]
    (path,) = (tmp_path / "recordings").iterdir()
    assert path.name == f"{SCENARIO.key}-vanilla_collision_filter_no.rrd"
    assert entities(path) >= {blueprint.COLOUR, blueprint.OBJECT, blueprint.CANDIDATES}
    assert blueprint.GRASP not in entities(path)


@pytest.mark.integration
def test_a_chosen_episode_is_recorded_with_its_box_and_plan(selector, tmp_path):
    path = record_scenario(SCENARIO, METHODS_OF_OURS["mvb"], lambda *_: selector, tmp_path)
    assert path == tmp_path / f"{SCENARIO.key}-mvb.rrd"
    assert entities(path) >= {blueprint.BOX, blueprint.GRASP, blueprint.PATH}


def test_a_success_is_recorded_only_with_all_others(tmp_path):
    assert not Recordings(folder=tmp_path, choice="failures").wants(success=True)
    assert Recordings(folder=tmp_path, choice="failures").wants(success=False)
    assert Recordings(folder=tmp_path, choice="all").wants(success=True)


@pytest.mark.integration
def test_what_saw_nothing_is_not_recorded(selector, tmp_path):
    hidden = replace(SCENARIO, occlusion=0.99)
    assert record_scenario(hidden, METHODS_OF_OURS["mvb"], lambda *_: selector, tmp_path) is None
    assert not list(tmp_path.iterdir())
