import pytest

from hal.base.errors import InvalidValueError
from sim_twin.benchmark.episodes.scenarios import OBJECT_SETS, PAPER_OBJECTS, Scenario, grid
from sim_twin.model.objects import EXTENDED_OBJECTS
from tests.support.errors import raises


def test_the_paper_has_81_scenarios_and_each_has_its_own_name_and_noise():
    scenarios = grid()
    assert len(scenarios) == 81
    assert len({s.key for s in scenarios}) == len({s.draw_seed for s in scenarios}) == 81
    assert {s.object for s in scenarios} == set(PAPER_OBJECTS)


def test_every_scenario_is_one_that_the_twin_can_build():
    for scenario in grid(occlusions=(0.0, 0.5)):
        scene = scenario.scene()
        assert scene.T_base_object()[0, 3] == pytest.approx({"near": 0.40, "mid": 0.48, "far": 0.56}[scenario.distance])


def test_the_extended_set_has_nine_upright_poses_per_object():
    scenarios = grid(objects=OBJECT_SETS["extended"])
    assert len(scenarios) == 9 * len(EXTENDED_OBJECTS)
    assert {s.pitch_deg for s in scenarios} == {0.0}


def test_seeds_and_occlusions_multiply_the_poses():
    scenarios = grid(objects=("box",), seeds=(0, 1), occlusions=(0.0, 0.25, 0.5))
    assert len(scenarios) == 27 * 2 * 3
    assert len({s.key for s in scenarios}) == len(scenarios)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("object", "banana"),
        ("distance", "close"),
        ("occlusion", 1.0),
        ("seed", -1),
    ],
)
def test_an_invalid_scenario_is_rejected(field, value):
    good = {"object": "box", "distance": "mid", "lateral": "left", "pitch_deg": 0.0}
    with raises(InvalidValueError, f"scenario_{field}"):
        Scenario(**{**good, field: value})
