from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from hal.base.errors import InvalidValueError
from models.types import Detection
from sim_twin.benchmark.episodes.contact_monitor import ContactMonitor
from sim_twin.benchmark.episodes.execution import capture
from sim_twin.benchmark.episodes.scenarios import Scenario, grid
from sim_twin.benchmark.episodes.targeting import TargetDetector, compute_iou, select_target
from sim_twin.model.objects import EXTENDED_OBJECTS, OBJECTS
from sim_twin.model.scene import Neighbour
from sim_twin.model.world import World
from tests.support.errors import raises
from z1_runtime.config import RuntimeConfig
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.perception.detectors.tabletop import TabletopDetector

CLUTTERED = Scenario(object="cylinder", distance="mid", lateral="left", pitch_deg=0.0, clutter=3)


def footprint(scene):
    """Return the position (2,) and the reach of each thing on the table [m], the object first."""
    pose = scene.T_base_object()
    things = [(pose, scene.grasp_object)]
    things += [(neighbour.T_base_object(), OBJECTS[neighbour.object]) for neighbour in scene.neighbours]
    return [(T[:2, 3], np.hypot(*(grasp_object.corners() @ T[:3, :3].T)[:, :2].T).max()) for T, grasp_object in things]


@pytest.mark.integration
@pytest.mark.parametrize("count", [1, 2, 3])
def test_neighbours_stand_apart_from_the_object_and_from_each_other_and_not_before_it(count):
    for scenario in grid(clutters=(count,)):
        scene = scenario.scene()
        (middle, radius_m), *others = footprint(scene)
        assert len(others) == count
        for where, own_m in others:
            assert 0.069 < np.linalg.norm(where - middle) - radius_m - own_m < 0.131
            assert (where - middle) @ middle / np.linalg.norm(middle) > -0.5 * np.linalg.norm(where - middle)
        for (a, r), (b, s) in combinations(others, 2):
            assert np.linalg.norm(a - b) > r + s
        assert scenario.object not in {neighbour.object for neighbour in scene.neighbours}


def test_the_same_scenario_has_the_same_neighbours_and_the_row_names_them():
    assert CLUTTERED.scene() == CLUTTERED.scene()
    assert len({s.scene().neighbours for s in grid(clutters=(2,))}) == 81
    assert CLUTTERED.columns()["neighbours"] == [n.object for n in CLUTTERED.scene().neighbours]
    assert Scenario.from_row(CLUTTERED.columns()) == CLUTTERED


def test_the_extended_sets_neighbours_are_of_that_set():
    for scenario in grid(("mug", "plate"), clutters=(3,)):
        assert {n.object for n in scenario.scene().neighbours} <= set(EXTENDED_OBJECTS)


@pytest.mark.integration
def test_neighbours_stand_and_one_that_is_pushed_over_is_counted():
    world = World(CLUTTERED.scene())
    watch = ContactMonitor(world)
    world.advance_to(0.5)
    assert watch.neighbours_knocked() == 0
    start = world.model.joint("neighbour_1").qposadr[0]
    world.data.qpos[start + 3 : start + 7] = [0.9, 0.43, 0.0, 0.0]
    world.advance_to(1.0)
    assert watch.neighbours_knocked() == 1
    np.testing.assert_allclose(world.T_base_object()[:3, 3], CLUTTERED.scene().T_base_object()[:3, 3], atol=2e-3)


@pytest.mark.integration
@pytest.mark.parametrize("lateral", ["left", "right"])
def test_a_detector_without_classes_is_pointed_at_the_object(lateral):
    scenario = replace(CLUTTERED, lateral=lateral)
    config, detector = select_target(RuntimeConfig(), TabletopDetector(), scenario)
    assert config.object_class is None
    frame, q = capture(scenario.scene())
    T_base_camera = Kinematics().flange(q[:6]) @ scenario.scene().T_flange_camera()
    assert len(TabletopDetector().detect(frame, T_base_camera)) > 1
    (found,) = detector.detect(frame, T_base_camera)
    assert compute_iou(found, frame.ground_truth_mask) > 0.6
    gone = replace(frame, ground_truth_mask=np.zeros_like(frame.ground_truth_mask))
    assert detector.detect(gone, T_base_camera) == []


class Labelled:
    """A detector that knows the paper's classes."""

    classes, min_confidence = ("bottle", "box", "cylinder"), 0.5


class OfCoco(Labelled):
    classes = ("bottle", "book", "dog")


def test_a_detector_with_classes_gets_the_objects_class():
    for clutter in (0, 2):
        detector = Labelled()
        config, same = select_target(RuntimeConfig(object_class="box"), detector, replace(CLUTTERED, clutter=clutter))
        assert config.object_class == "cylinder"
        assert same is detector


def test_a_detector_that_lacks_a_class_of_the_papers_is_rejected():
    with pytest.raises(InvalidValueError):
        select_target(RuntimeConfig(), OfCoco(), CLUTTERED)


def test_an_object_of_no_class_is_detected_as_the_user_chose_or_above_the_table():
    mug = replace(CLUTTERED, object="mug", clutter=0)
    config, detector = select_target(RuntimeConfig(object_class="bottle"), Labelled(), mug)
    assert config.object_class == "bottle"
    assert isinstance(detector, Labelled)
    assert isinstance(select_target(RuntimeConfig(), Labelled(), mug)[1], TabletopDetector)
    assert isinstance(select_target(RuntimeConfig(), Labelled(), replace(mug, clutter=1))[1], TargetDetector)


def test_a_box_counts_where_there_is_no_mask():
    ground_truth = np.zeros((10, 10), dtype=bool)
    ground_truth[2:6, 4:8] = True
    assert compute_iou(Detection(label="x", confidence=1.0, box_px=(4, 2, 8, 6)), ground_truth) == 1.0
    assert compute_iou(Detection(label="x", confidence=1.0, box_px=(4, 2, 8, 4)), ground_truth) == 0.5


def test_an_unknown_neighbour_is_rejected():
    with raises(InvalidValueError, "unknown_object"):
        Neighbour(object="banana", x_m=0.5, y_m=0.0)
    with raises(InvalidValueError, "scenario_clutter"):
        replace(CLUTTERED, clutter=4)
