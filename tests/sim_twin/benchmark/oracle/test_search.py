import numpy as np
import pytest

from hal.base.errors import InvalidValueError
from sim_twin.benchmark.episodes.execution import EpisodeRobot, Mode, Outcome
from sim_twin.benchmark.episodes.scenarios import Scenario
from sim_twin.benchmark.oracle import reachable_grasps
from sim_twin.benchmark.oracle.candidates import SweepConfig, sweep_grasps
from sim_twin.benchmark.oracle.reachable_grasps import EXACT_PLANNER, GroundTruthScene
from sim_twin.benchmark.oracle.search import OracleConfig, search
from sim_twin.benchmark.oracle.surface import Surface
from sim_twin.model.objects import OBJECTS
from sim_twin.model.parts import GraspObject, Part
from tests.support.errors import raises
from z1_runtime.geometry.kinematics import Kinematics

BOX = Scenario(object="box", distance="mid", lateral="centre", pitch_deg=0.0)
FEW = SweepConfig(n_points=60, n_approaches=8, cell_m=0.02)


@pytest.fixture(scope="module")
def find_grasps():
    return GroundTruthScene(BOX.scene(), Kinematics(), EXACT_PLANNER, 0.5).find_grasps(FEW)


def test_a_boxs_surface_is_sampled_on_all_six_sides_with_outward_normals():
    points, normals = Surface(OBJECTS["box"]).sample(0.004)
    half = np.array([0.035, 0.020, 0.075])
    assert np.abs(np.abs(points / half).max(axis=1) - 1.0).max() < 1e-9
    assert (np.sum(points * normals, axis=1) > 0.0).all()
    shares = [np.mean(normals @ side > 0.99) for side in (*np.eye(3), *-np.eye(3))]
    areas = np.array([0.04 * 0.15, 0.07 * 0.15, 0.07 * 0.04] * 2)
    np.testing.assert_allclose(shares, areas / areas.sum(), atol=0.03)


@pytest.mark.parametrize("name", ["mug", "l_block", "bottle"])
def test_no_point_of_a_surface_is_inside_the_object(name):
    surface = Surface(OBJECTS[name])
    points, normals = surface.sample(0.003)
    just_outside = points + 3e-4 * normals
    assert not any(hull.contains(just_outside).any() for hull in surface._hulls)


def test_a_chord_through_a_mug_ends_at_its_wall_and_at_the_far_side():
    surface = Surface(OBJECTS["mug"])
    wall, far = surface.trace_chords(np.array([[-0.0315, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0]]))
    assert wall.points[0, 0] == pytest.approx(-0.0275, abs=1e-3)
    assert far.points[0, 0] == pytest.approx(0.0315, abs=1e-3)
    assert far.normals[0] @ [1.0, 0.0, 0.0] > 0.98


def test_grasps_come_from_all_sides_but_from_below_with_contacts_on_the_surface():
    T_base_object = BOX.scene().T_base_object()
    grasps = sweep_grasps(Surface(OBJECTS["box"]), T_base_object, 0.012, FEW)
    T = grasps.T_camera_grasps
    np.testing.assert_allclose(
        T[:, :3, :3].transpose(0, 2, 1) @ T[:, :3, :3], np.tile(np.eye(3), (len(T), 1, 1)), atol=1e-9
    )
    approaches = T[:, :3, 2]
    assert approaches[:, 2].max() < FEW.max_rise
    for side in ([1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, -1]):
        assert (approaches @ side).max() > 0.9
    middles = T[:, :3, 3] - 0.012 * approaches - T_base_object[:3, 3]
    for side in (-1.0, 1.0):
        contacts = middles + side * 0.5 * grasps.widths_m[:, None] * T[:, :3, 1]
        assert np.abs(np.abs(contacts / [0.035, 0.020, 0.075]).max(axis=1) - 1.0).max() < 1e-6


@pytest.mark.integration
def test_after_a_failure_what_is_unlike_it_comes_next_and_copies_never(find_grasps):
    tried = []
    while (option := find_grasps.next()) is not None:
        find_grasps.add_failure(option)
        tried.append(option)
    best = np.argsort(-find_grasps._value)[:6]
    assert 20 < len(tried) < len(find_grasps)
    assert len({id(option) for option in tried}) == len(tried)
    assert _spread(tried[:6]) > 1.2 * _spread([find_grasps._grasps[k] for k in best])


def _spread(some):
    """Return the mean distance between `some` placements: of directions and, weighted tenfold, of metres."""
    descriptors = [reachable_grasps._descriptor(grasp.placement) for grasp in some]
    traits = np.array(descriptors) * np.repeat([1.0, 10.0], [6, 3])
    return np.linalg.norm(traits[:, None] - traits[None], axis=2).mean()


@pytest.mark.integration
def test_a_finer_sweep_remembers_what_failed(find_grasps):
    truth = GroundTruthScene(BOX.scene(), Kinematics(), EXACT_PLANNER, 0.5)
    first, again = truth.find_grasps(FEW), truth.find_grasps(FEW)
    best = first.next()
    assert best is not None
    first.add_failure(best)
    assert first.with_failures(again).next() is not None
    following = again.next()
    assert following is not None
    assert not np.allclose(following.placement.T_base_pivot, best.placement.T_base_pivot)


@pytest.mark.integration
def test_an_upright_box_is_lifted_by_the_first_grasp():
    row = search(BOX, OracleConfig(sweep=FEW))
    assert row["success"]
    assert row["verdict"] == "solved"
    assert row["executions"] == 1
    assert row["modes"] == ["success"]
    assert row["lifted_m"] > 0.05
    assert 0 < row["n_clear"] < row["n_candidates"]


def test_what_is_too_wide_on_all_sides_is_unreachable():
    cube = GraspObject(
        height_m=0.12, parts=(Part(kind="box", size_m=(0.06,) * 3, mass_kg=0.3, rgba=(1.0, 1.0, 1.0, 1.0)),)
    )
    wide = Scenario(object="cube", shape=cube, distance="mid", lateral="centre", pitch_deg=0.0)
    row = search(wide, OracleConfig(sweep=FEW, finer=FEW))
    assert not row["success"]
    assert row["verdict"] == "unreachable"
    assert row["exhausted"]
    assert row["executions"] == row["n_reachable"] == 0


@pytest.mark.integration
def test_where_all_fails_the_budget_is_spent_on_grasps_that_differ(monkeypatch):
    plans = []

    def miss(_robot, plan):
        plans.append(plan)
        return Outcome(mode=Mode.MISSED)

    monkeypatch.setattr(EpisodeRobot, "execute", miss)
    row = search(BOX, OracleConfig(sweep=FEW, finer=FEW, executions=6, finer_after=3))
    assert row["verdict"] == "unsolved"
    assert row["modes"] == ["missed"] * 6
    assert not row["exhausted"]
    poses = np.array([plan.T_base_pivot for plan in plans])
    for k in range(1, len(poses)):
        moved = np.linalg.norm(poses[:k, :3, 3] - poses[k, :3, 3], axis=1)
        turned = np.linalg.norm(poses[:k, :3, :3] - poses[k, :3, :3], axis=(1, 2))
        assert (10.0 * moved + turned).min() > 0.3


@pytest.mark.integration
def test_a_search_says_the_same_each_time(monkeypatch):
    monkeypatch.setattr(EpisodeRobot, "execute", lambda *_: Outcome(mode=Mode.DROPPED))
    config = OracleConfig(sweep=FEW, executions=2)
    first, second = (search(BOX, config) for _ in range(2))
    for row in (first, second):
        del row["search_ms"]
    assert repr(first) == repr(second)


def test_an_empty_budget_is_refused():
    with raises(InvalidValueError, "oracle_budget"):
        OracleConfig(executions=0)
