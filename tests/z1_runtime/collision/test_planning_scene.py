"""The planning scene holds table, object and obstacles in the base frame, without the robot itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from hal.base.errors import InvalidValueError
from tests.support.errors import raises
from tests.support.tabletop_scenes import Q_START, camera_pose, cylinder, make_observation, wall
from z1_runtime.collision.planning_scene import PlanningScene
from z1_runtime.geometry.gripper_geometry import gripper_shape
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.types import Observation


@pytest.fixture(scope="module")
def kinematics() -> Kinematics:
    return Kinematics()


def make_scene(kinematics: Kinematics, observation: Observation, q: np.ndarray | None = Q_START) -> PlanningScene:
    return PlanningScene.from_observation(observation, q, kinematics)


def test_everything_is_in_the_base_frame(kinematics):
    T_base_camera = camera_pose(kinematics)
    points = cylinder(0.48, 0.0, T_base_camera[:3, 3])
    scene = make_scene(kinematics, make_observation(T_base_camera, points, wall(0.60, 0.0)))
    assert scene.table.normal == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)
    assert scene.table.offset_m == pytest.approx(0.0, abs=1e-9)
    assert scene.object_points == pytest.approx(points, abs=1e-9)
    assert scene.scene_index.points[:, 0] == pytest.approx(0.60, abs=1e-9)  # the table itself is left to the plane


def test_the_object_s_own_border_and_its_occluded_points_are_no_obstacles(kinematics):
    T_base_camera = camera_pose(kinematics)
    points = cylinder(0.48, 0.0, T_base_camera[:3, 3])
    observation = make_observation(T_base_camera, points, points[::50] + np.array([0.0, 0.003, 0.0]))
    behind = make_observation(T_base_camera, points + np.array([0.02, 0.0, 0.0])).object_points[:100]
    scene = make_scene(kinematics, replace(observation, occluded_points=behind))
    assert len(scene.scene_index) == 0
    assert len(scene.object_index) == len(points) + 100


def test_a_point_that_is_not_finite_is_an_error(kinematics):
    T_base_camera = camera_pose(kinematics)
    points = cylinder(0.48, 0.0, T_base_camera[:3, 3])
    points[0, 0] = np.nan
    with raises(InvalidValueError, "not_finite"):
        make_scene(kinematics, make_observation(T_base_camera, points))


def test_points_on_the_robot_s_own_gripper_are_no_obstacle(kinematics):
    T_base_camera = camera_pose(kinematics)
    T_base_pivot = kinematics.pivot(z1.Q_HOME)
    jaw_points = gripper_shape().fixed[::3] @ T_base_pivot[:3, :3].T + T_base_pivot[:3, 3]
    points = cylinder(0.48, 0.0, T_base_camera[:3, 3])
    observation = make_observation(T_base_camera, points, jaw_points)
    assert len(make_scene(kinematics, observation, q=None).scene_index) > 0
    assert len(make_scene(kinematics, observation).scene_index) == 0


def test_an_object_cut_off_by_the_picture_s_edge_continues_to_the_table(kinematics):
    T_base_camera = camera_pose(kinematics)
    points = cylinder(0.48, 0.0, T_base_camera[:3, 3])
    upper = make_scene(kinematics, make_observation(T_base_camera, points[points[:, 2] > 0.10]))
    below_the_cut = np.array([[0.45, 0.0, 0.04]])
    assert upper.object_index.near(below_the_cut, 0.003).all()
    whole = make_scene(kinematics, make_observation(T_base_camera, points))
    assert len(whole.object_index) == len(points)
