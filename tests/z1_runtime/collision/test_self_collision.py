"""The arm's capsules against its meshes, the table and the arm itself."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from hal.base import z1
from hal.base.z1 import CAPSULES
from tests.support.tabletop_scenes import camera_pose, cylinder, make_checker, make_observation
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.collision.self_collision import ArmPoses, check_arm
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.types import Plane, PlanningStage, RejectionReason

FOLDED_INTO_BASE = np.array([0.0, 0.6, 0.0, 1.2, 0.0, 1.57, 0.0])


@pytest.fixture(scope="module")
def kinematics() -> Kinematics:
    return Kinematics()


@pytest.fixture(scope="module")
def checker(kinematics) -> CollisionChecker:
    T_base_camera = camera_pose(kinematics)
    return make_checker(kinematics, make_observation(T_base_camera, cylinder(0.48, 0.0, T_base_camera[:3, 3])))


@pytest.mark.integration
def test_the_link_capsules_contain_the_meshes_to_a_centimetre():
    for number in range(6):
        vertices = trimesh.load_mesh(z1.mesh_dir() / "collision" / f"z1_Link0{number}.STL").vertices
        outside = np.full(len(vertices), np.inf)
        for capsule in (c for c in CAPSULES if c.link == f"link0{number}"):
            start, axis = np.array(capsule.start), np.array(capsule.end) - capsule.start
            t = np.clip((vertices - start) @ axis / (axis @ axis), 0.0, 1.0)
            distance = np.linalg.norm(vertices - start - t[:, None] * axis, axis=1)
            outside = np.minimum(outside, distance - capsule.radius_m)
        assert outside.max() < 0.0105, f"link0{number}"


def test_home_is_free_with_any_jaw_opening(checker):
    for jaw in np.linspace(z1.GRIPPER_OPEN, z1.GRIPPER_CLOSED, 5):
        assert checker.check_posture(np.append(z1.Q_HOME, jaw)) is None


def test_an_arm_folded_into_its_own_base_is_found(checker):
    rejection = checker.check_posture(FOLDED_INTO_BASE)
    assert rejection is not None
    assert rejection.reason == "self"


def test_an_open_jaw_that_swings_into_the_forearm_is_found(checker):
    q = np.array([-1.25, 0.39, -0.81, 1.45, -0.64, -1.67, 0.0])
    assert checker.check_posture(q) is None
    q[-1] = z1.GRIPPER_OPEN
    rejection = checker.check_posture(q)
    assert rejection is not None
    assert rejection.reason == "self"
    assert "moving jaw" in rejection.detail


def test_the_first_contact_of_several_postures_names_reason_stage_and_height(kinematics):
    home = np.append(z1.Q_HOME, 0.0)
    low = np.array([0.0, 2.4, -0.9, 0.3, 0.0, 0.0, 0.0])
    table = Plane(normal=np.array([0.0, 0.0, 1.0]), offset_m=0.0)
    at_home, both = (ArmPoses.at(kinematics, np.array(qs)) for qs in ([home], [home, low]))
    assert check_arm(at_home, table, 0.010, PlanningStage.LIFT) is None
    rejection = check_arm(both, table, 0.010, PlanningStage.LIFT)
    assert rejection is not None
    assert (rejection.reason, rejection.stage) == (RejectionReason.TABLE, PlanningStage.LIFT)
    assert rejection.rank is None
    assert "allowed is 10 mm" in rejection.detail
