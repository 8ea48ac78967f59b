"""The voxel index against brute force, and the arm against table, itself, scene and object."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hal.base import z1
from hal.base.z1_shape import CAPSULES
from tests.support.tabletop_scenes import Q_START, camera_pose, cylinder, frontal, make_observation, wall
from z1_runtime.collision.scene_collision import CollisionChecker, CollisionConfig
from z1_runtime.collision.voxel_grid import SceneIndex
from z1_runtime.geometry.gripper_mesh import gripper_shape
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.beak_gripper import BeakGripper
from z1_runtime.motion.limits import MotionLimits
from z1_runtime.motion.trajectory import gripper_move, joint_move

FOLDED_INTO_BASE = np.array([0.0, 0.6, 0.0, 1.2, 0.0, 1.57, 0.0])


@pytest.fixture(scope="module")
def kinematics() -> Kinematics:
    return Kinematics()


@pytest.fixture(scope="module")
def checker(kinematics) -> CollisionChecker:
    T_base_camera = camera_pose(kinematics)
    points = cylinder(0.48, 0.0, T_base_camera[:3, 3])
    observation = make_observation(T_base_camera, points, wall(0.60, 0.0))
    return CollisionChecker(kinematics, observation, Q_START)


def random_poses(n: int, rng: np.random.Generator, reach_m: float) -> np.ndarray:
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.random(n, rng=rng).as_matrix()
    T[:, :3, 3] = rng.uniform(-reach_m, reach_m, (n, 3))
    return T


@pytest.mark.parametrize("seed", range(12))
def test_the_index_answers_as_brute_force_does(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.2, 0.2, (int(rng.integers(1, 4000)), 3))
    vertices = rng.uniform(-0.05, 0.05, (80, 3))
    T = random_poses(60, rng, 0.28)
    threshold = float(rng.uniform(0.001, 0.010))
    moved = np.einsum("nij,vj->nvi", T[:, :3, :3], vertices) + T[:, None, :3, 3]
    distance = cKDTree(points).query(moved.reshape(-1, 3))[0].reshape(60, 80)
    index = SceneIndex(points)
    hit_vertex, hit_point = index.first_hits(T, vertices, threshold)
    assert ((hit_vertex >= 0) == (distance.min(axis=1) <= threshold)).all()
    assert (index.collides(T, vertices, threshold) == (hit_vertex >= 0)).all()
    for n in np.flatnonzero(hit_vertex >= 0):
        assert np.linalg.norm(moved[n, hit_vertex[n]] - points[hit_point[n]]) <= threshold
    assert (index.near(moved[0], threshold) == (distance[0] <= threshold)).all()


def test_the_paper_s_threshold_is_kept_to_a_micrometre():
    index = SceneIndex(np.array([[0.0, 0.0, 0.0]]))
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, 0, 3] = [0.001999, 0.002001]
    assert index.collides(T, np.zeros((1, 3)), 0.002).tolist() == [True, False]


def test_an_empty_cloud_is_never_hit():
    index = SceneIndex(np.empty((0, 3)))
    assert not index.collides(np.eye(4)[None], np.zeros((5, 3)), 0.002).any()
    assert not index.near(np.zeros((5, 3)), 0.002).any()


def test_points_that_are_not_finite_and_thresholds_too_large_are_refused():
    with pytest.raises(ValueError, match="not finite"):
        SceneIndex(np.array([[0.0, np.nan, 0.0]]))
    with pytest.raises(ValueError, match=r"0.02 m; this index serves 0 to 0.01"):
        SceneIndex(np.zeros((1, 3))).collides(np.eye(4)[None], np.zeros((1, 3)), 0.02)


def test_the_gripper_s_points_cover_its_meshes_without_gaps():
    shape = gripper_shape()
    assert 1500 < len(shape) < 3000
    mesh = trimesh.load_mesh(z1.mesh_dir() / "collision" / "z1_GripperMover.STL")
    dense = trimesh.sample.sample_surface(mesh, 20_000, seed=3)[0]
    assert cKDTree(shape.mover).query(dense)[0].max() < 0.008


def test_the_link_capsules_hold_the_meshes_to_a_centimetre():
    for number in range(6):
        vertices = trimesh.load_mesh(z1.mesh_dir() / "collision" / f"z1_Link0{number}.STL").vertices
        outside = np.full(len(vertices), np.inf)
        for capsule in (c for c in CAPSULES if c.link == f"link0{number}"):
            start, way = np.array(capsule.start), np.array(capsule.end) - capsule.start
            t = np.clip((vertices - start) @ way / (way @ way), 0.0, 1.0)
            distance = np.linalg.norm(vertices - start - t[:, None] * way, axis=1)
            outside = np.minimum(outside, distance - capsule.radius_m)
        assert outside.max() < 0.0105, f"link0{number}"


def test_home_is_free_with_any_jaw_opening(checker):
    for jaw in np.linspace(z1.GRIPPER_OPEN, z1.GRIPPER_CLOSED, 5):
        assert checker.check_posture(np.append(z1.Q_HOME, jaw)) is None


def test_an_arm_folded_into_its_own_base_is_found(checker):
    problem = checker.check_posture(FOLDED_INTO_BASE)
    assert problem is not None
    assert problem.reason == "self"


def test_an_open_jaw_that_swings_into_the_forearm_is_found(checker):
    q = np.array([-1.25, 0.39, -0.81, 1.45, -0.64, -1.67, 0.0])
    assert checker.check_posture(q) is None
    q[-1] = z1.GRIPPER_OPEN
    problem = checker.check_posture(q)
    assert problem is not None
    assert problem.reason == "self"
    assert "moving jaw" in problem.detail


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"transfer_threshold_m": 0.02}, "transfer_threshold_m is 0.02; allowed is 0 to 0.01"),
        ({"link_margin_m": -0.01}, "link_margin_m is -0.01"),
        ({"sample_s": float("nan")}, "sample_s is nan"),
    ],
)
def test_distances_that_make_no_sense_are_refused(wrong, said):
    with pytest.raises(ValueError, match=said):
        CollisionConfig(**wrong)


def test_an_arm_reaching_into_the_table_is_found(checker):
    q = np.array([0.0, 2.4, -0.9, 0.3, 0.0, 0.0, 0.0])
    trajectory = joint_move(Q_START, q)
    problem = checker.check_trajectory(trajectory, threshold_m=0.005)
    assert problem is not None
    assert problem.reason == "table"
    assert "above the table" in problem.detail


def pivots_at(x: float, y: float, z: float) -> tuple[np.ndarray, float]:
    _, grasp = BeakGripper().fit(frontal(x, y, z, 0.0), 0.06)  # the flip with the camera above the hand
    return grasp.T_base_pivot[None], grasp.jaw_open


def test_jaws_that_come_too_near_to_the_table_while_they_close_are_found(checker, kinematics):
    verdicts = []
    for z in np.arange(0.11, 0.0, -0.01):
        _, grasp = BeakGripper().fit(frontal(0.48, 0.0, z, np.deg2rad(30)), 0.06)
        (q, *_) = kinematics.solve(grasp.T_base_pivot)
        close = gripper_move(np.append(q, grasp.jaw_open), 0.0, MotionLimits.at_speed(0.5))
        pivots = np.repeat(grasp.T_base_pivot[None], len(close.q), axis=0)
        lowest = checker.check_grippers(pivots, close.q[:, -1]).height_m.min()
        verdicts.append(checker.check_closing(close))
        assert (verdicts[-1] is None) == (lowest >= checker.config.closing_margin_m)
    refused = [problem for problem in verdicts if problem is not None]
    assert 0 < len(refused) < len(verdicts)
    assert all(problem.reason == "table" for problem in refused)


def test_the_jaws_around_the_object_are_free(checker):
    pivots, jaw = pivots_at(0.48, 0.0, 0.09)
    hits = checker.check_grippers(pivots, np.array([jaw]))
    assert hits.problem(0) is None
    assert hits.free().all()


@pytest.mark.parametrize(
    ("place", "reason"),
    [((0.48, 0.035, 0.09), "object"), ((0.60, 0.0, 0.12), "scene"), ((0.48, 0.0, 0.02), "table")],
)
def test_a_gripper_pose_names_what_it_hits(checker, place, reason):
    pivots, jaw = pivots_at(*place)
    problem = checker.check_grippers(pivots, np.array([jaw])).problem(0)
    assert problem is not None
    assert problem.reason == reason
    assert " m" in problem.detail


def test_a_held_object_and_the_table_s_noise_are_left_out(checker):
    pivots, jaw = pivots_at(0.48, 0.035, 0.09)
    assert checker.check_grippers(pivots, np.array([jaw]), object_threshold_m=-1.0).free().all()
    heights = checker.table.height_m(checker.scene_index.points)
    assert heights.min() > checker.config.table_noise_m


def test_the_robot_s_own_gripper_in_the_picture_is_no_obstacle(kinematics):
    T_base_camera = camera_pose(kinematics)
    T_base_pivot = kinematics.pivot(z1.Q_HOME)
    jaw_points = gripper_shape().fixed[::3] @ T_base_pivot[:3, :3].T + T_base_pivot[:3, 3]
    points = cylinder(0.48, 0.0, T_base_camera[:3, 3])
    observation = make_observation(T_base_camera, points, jaw_points)
    checker = CollisionChecker(kinematics, observation, Q_START)
    assert len(checker.scene_index) == 0


def test_an_object_cut_off_by_the_picture_s_edge_goes_on_down_to_the_table(kinematics):
    T_base_camera = camera_pose(kinematics)
    points = cylinder(0.48, 0.0, T_base_camera[:3, 3])
    upper = CollisionChecker(kinematics, make_observation(T_base_camera, points[points[:, 2] > 0.10]), Q_START)
    below_the_cut = np.array([[0.45, 0.0, 0.04]])
    assert upper.object_index.near(below_the_cut, 0.003).all()
    whole = CollisionChecker(kinematics, make_observation(T_base_camera, points), Q_START)
    assert len(whole.object_index) == len(points)
