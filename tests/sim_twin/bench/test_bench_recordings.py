import numpy as np
import pytest
from rerun.chunk import RrdReader

from models.types import GraspSet
from sim_twin.bench.episode import run_scenario
from sim_twin.bench.methods import parse_method
from sim_twin.bench.recordings import Recordings
from sim_twin.bench.scenarios import Scenario
from sim_twin.bench.trial import look
from z1_runtime import blueprint
from z1_runtime.assembly import make_decider
from z1_runtime.config import RuntimeConfig

SCENARIO = Scenario(object="cylinder", distance="mid", lateral="centre", pitch_deg=0.0)
METHODS = [parse_method("vanilla:collision_filter=no")]


@pytest.fixture(scope="module")
def decider():
    return make_decider(RuntimeConfig(generator="antipodal", detector="tabletop", n_candidates=400))


def entities(path):
    return {chunk.entity_path.strip("/") for chunk in RrdReader(path).stream().to_chunks()}


def test_a_failure_is_recorded_with_what_was_seen_and_ranked(decider, tmp_path, monkeypatch):
    at_the_lens = GraspSet(T_camera_grasps=np.tile(np.eye(4), (3, 1, 1)), scores=np.ones(3), widths_m=np.full(3, 0.04))
    monkeypatch.setattr(type(decider), "propose", lambda self, observation: at_the_lens)
    recordings = Recordings(folder=tmp_path / "recordings", choice="failures")
    (row,) = run_scenario(SCENARIO, METHODS, lambda _: decider, recordings)
    assert not row["success"]
    (path,) = (tmp_path / "recordings").iterdir()
    assert path.name == f"{SCENARIO.key}-vanilla_collision_filter_no.rrd"
    assert entities(path) >= {blueprint.COLOUR, blueprint.OBJECT, blueprint.CANDIDATES}
    assert blueprint.GRASP not in entities(path)


@pytest.mark.parametrize(("choice", "kept"), [("failures", []), ("all", ["mvb.rrd"])])
def test_a_success_is_recorded_only_with_all_others(decider, tmp_path, choice, kept):
    frame, q = look(SCENARIO.scene())
    decision = decider.decide(frame, q)
    recordings = Recordings(folder=tmp_path, choice=choice)
    recordings.keep("mvb", success=True, observation=decision.observation, ranked=decision.ranked, plan=decision.plan)
    assert [path.name for path in tmp_path.iterdir()] == kept
    if kept:
        assert entities(tmp_path / "mvb.rrd") >= {blueprint.BOX, blueprint.GRASP, blueprint.PATH}
