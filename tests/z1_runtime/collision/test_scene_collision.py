"""Gripper poses and trajectories against table, scene and object."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from hal.base import z1
from hal.base.errors import InvalidValueError
from tests.support.errors import raises
from tests.support.tabletop_scenes import (
    Q_START,
    camera_pose,
    cylinder,
    frontal,
    make_checker,
    make_observation,
    wall,
)
from z1_runtime.collision.planning_scene import CollisionConfig
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.gripper_geometry import gripper_shape
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.beak_gripper import BeakGripper
from z1_runtime.motion.limits import MotionLimits
from z1_runtime.motion.trajectory import gripper_move, joint_move


@pytest.fixture(scope="module")
def kinematics() -> Kinematics:
    return Kinematics()


@pytest.fixture(scope="module")
def checker(kinematics) -> CollisionChecker:
    T_base_camera = camera_pose(kinematics)
    points = cylinder(0.48, 0.0, T_base_camera[:3, 3])
    observation = make_observation(T_base_camera, points, wall(0.60, 0.0))
    return make_checker(kinematics, observation)


def test_the_gripper_s_points_cover_its_meshes_without_gaps():
    shape = gripper_shape()
    assert 1500 < len(shape) < 3000
    mesh = trimesh.load_mesh(z1.mesh_dir() / "collision" / "z1_GripperMover.STL")
    dense = trimesh.sample.sample_surface(mesh, 20_000, seed=3)[0]
    assert cKDTree(shape.moving_jaw).query(dense)[0].max() < 0.008


@pytest.mark.parametrize(
    "wrong", [{"transfer_threshold_m": 0.02}, {"link_margin_m": -0.01}, {"sample_s": float("nan")}], ids=str
)
def test_invalid_distances_are_rejected(wrong):
    with raises(InvalidValueError, "invalid_value"):
        CollisionConfig(**wrong)


def test_an_arm_reaching_into_the_table_is_found(checker):
    q = np.array([0.0, 2.4, -0.9, 0.3, 0.0, 0.0, 0.0])
    trajectory = joint_move(Q_START, q)
    rejection = checker.check_trajectory(trajectory, threshold_m=0.005)
    assert rejection is not None
    assert rejection.reason == "table"
    assert "above the table" in rejection.detail


def pivots_at(x: float, y: float, z: float) -> tuple[np.ndarray, float]:
    _, grasp = BeakGripper().fit(frontal(x, y, z, 0.0), 0.06)  # the flip with the camera above the gripper
    return grasp.T_base_pivot[None], grasp.jaw_open


@pytest.mark.integration
def test_jaws_that_come_too_near_to_the_table_while_they_close_are_found(checker, kinematics):
    rejections = []
    for z in np.arange(0.11, 0.0, -0.01):
        _, grasp = BeakGripper().fit(frontal(0.48, 0.0, z, np.deg2rad(30)), 0.06)
        (q, *_) = kinematics.solve(grasp.T_base_pivot)
        close = gripper_move(np.append(q, grasp.jaw_open), 0.0, MotionLimits.at_speed(0.5))
        pivots = np.repeat(grasp.T_base_pivot[None], len(close.q), axis=0)
        lowest = checker.check_grippers(pivots, close.q[:, -1]).height_m.min()
        rejections.append(checker.check_closing(close))
        assert (rejections[-1] is None) == (lowest >= checker.config.closing_margin_m)
    reasons = [rejection.reason for rejection in rejections if rejection is not None]
    assert 0 < len(reasons) < len(rejections)
    assert set(reasons) == {"table"}


def test_the_jaws_around_the_object_are_free(checker):
    pivots, jaw = pivots_at(0.48, 0.0, 0.09)
    hits = checker.check_grippers(pivots, np.array([jaw]))
    assert hits.rejection(0) is None
    assert hits.free().all()


@pytest.mark.parametrize(
    ("place", "reason"),
    [((0.48, 0.035, 0.09), "object"), ((0.60, 0.0, 0.12), "scene"), ((0.48, 0.0, 0.02), "table")],
)
def test_a_gripper_pose_names_what_it_hits(checker, place, reason):
    pivots, jaw = pivots_at(*place)
    rejection = checker.check_grippers(pivots, np.array([jaw])).rejection(0)
    assert rejection is not None
    assert rejection.reason == reason
    assert " m" in rejection.detail


def test_a_held_object_and_the_table_s_noise_are_left_out(checker):
    pivots, jaw = pivots_at(0.48, 0.035, 0.09)
    assert checker.check_grippers(pivots, np.array([jaw]), object_threshold_m=-1.0).free().all()
    heights = checker.scene.table.height_m(checker.scene.scene_index.points)
    assert heights.min() > checker.config.table_noise_m
