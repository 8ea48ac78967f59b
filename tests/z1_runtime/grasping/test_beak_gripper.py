"""The gripper's fit to a width, compared with the STL meshes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.base import z1
from hal.base.transforms import inverse
from hal.base.z1 import JAW_REACH_M, KNEE_RADIUS_M, MOVING_FACE, STATIONARY_FACE, moving_jaw_pose
from tests.support.errors import raises
from z1_runtime.geometry.gripper_geometry import GripperPlacementConfig
from z1_runtime.grasping.beak_gripper import BeakGripper, WidthError

TIGHT = GripperPlacementConfig(clearance_m=0.0)


def surface(name: str, offset_x: float) -> np.ndarray:
    """Return dense points of a jaw's mesh in the pivot frame, closed."""
    mesh = trimesh.load_mesh(z1.mesh_dir() / "collision" / f"{name}.STL")
    points = np.asarray(trimesh.sample.sample_surface(mesh, 60_000, seed=0)[0])
    return points + np.array([offset_x, 0.0, 0.0])


@pytest.fixture(scope="module")
def stator() -> np.ndarray:
    return surface("z1_GripperStator", -0.049)


@pytest.fixture(scope="module")
def moving_jaw() -> np.ndarray:
    return surface("z1_GripperMover", 0.0)


def lateral_gaps(
    T_base_pivot: np.ndarray, jaw: float, stator: np.ndarray, moving_jaw: np.ndarray, r: float
) -> list[float]:
    """Return each jaw's distance from a disc-shaped pillar of radius `r` along grasp x at the grasp frame's origin."""
    gaps = []
    for T, points in ((T_base_pivot, stator), (T_base_pivot @ moving_jaw_pose(jaw), moving_jaw)):
        in_grasp = points @ T[:3, :3].T + T[:3, 3]
        gaps.append(float(np.hypot(in_grasp[:, 1], in_grasp[:, 2]).min() - r))
    return gaps


def without_palm(stator: np.ndarray) -> np.ndarray:
    """Return the stationary jaw's points before the palm, which has a clearance of its own."""
    return stator[stator[:, 0] > 0.045]


def contact_frame(config: GripperPlacementConfig) -> np.ndarray:
    """Return a grasp whose contact axis is the base frame's y axis."""
    T = np.eye(4)
    T[2, 3] = config.contact_depth_m
    return T


@pytest.mark.parametrize(
    ("face", "name", "offset"), [(STATIONARY_FACE, "stator", 0.0), (MOVING_FACE, "moving_jaw", 0.0)]
)
def test_the_measured_faces_are_on_the_meshes(face, name, offset, request):
    points = request.getfixturevalue(name)
    middle = points[np.abs(points[:, 1]) < 0.02][:, [0, 2]]
    nearest = np.linalg.norm(face[:, None] - middle, axis=2).min(axis=1)
    assert nearest.max() < 0.0015


def test_knees_and_tips_agree_with_the_faces():
    assert np.hypot(*MOVING_FACE[1]) == pytest.approx(KNEE_RADIUS_M, abs=1e-3)
    assert np.hypot(*STATIONARY_FACE[1]) == pytest.approx(KNEE_RADIUS_M, abs=1.5e-3)
    assert STATIONARY_FACE[0, 0] == MOVING_FACE[0, 0] == JAW_REACH_M


@pytest.mark.parametrize("width", [0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08])
def test_both_jaws_touch_a_round_object_of_that_width(width, stator, moving_jaw):
    for grasp in BeakGripper(TIGHT).fit(contact_frame(TIGHT), width):
        gaps = lateral_gaps(grasp.T_base_pivot, grasp.jaw_contact, stator, moving_jaw, 0.5 * width)
        assert np.abs(gaps).max() < 0.0015, gaps


@pytest.mark.parametrize("width", [0.02, 0.04, 0.06, 0.08])
def test_while_approaching_both_jaws_keep_their_clearance(width, stator, moving_jaw):
    config = GripperPlacementConfig()
    for grasp in BeakGripper(config).fit(contact_frame(config), width):
        gaps = lateral_gaps(grasp.T_base_pivot, grasp.jaw_open, without_palm(stator), moving_jaw, 0.5 * width)
        assert gaps == pytest.approx([config.clearance_m] * 2, abs=0.0015)


@pytest.mark.parametrize("width", [0.02, 0.04, 0.06, 0.08])
def test_while_closing_the_gripper_turns_so_that_both_jaws_arrive_together(width, stator, moving_jaw):
    config = GripperPlacementConfig()
    for grasp in BeakGripper(config).fit(contact_frame(config), width):
        assert grasp.T_base_touch[:3, 3] == pytest.approx(grasp.T_base_pivot[:3, 3], abs=1e-12)
        assert grasp.T_base_touch[:3, 1] == pytest.approx(grasp.T_base_pivot[:3, 1], abs=1e-12)
        gaps = lateral_gaps(grasp.T_base_touch, grasp.jaw_touch, stator, moving_jaw, 0.5 * width)
        assert gaps == pytest.approx([-0.5 * config.squeeze_m] * 2, abs=0.0015)
        assert grasp.jaw_open < grasp.jaw_contact < grasp.jaw_touch < 0.0


def test_the_flips_put_the_stationary_jaw_on_opposite_sides():
    plain, flipped = BeakGripper().fit(np.eye(4), 0.05)
    sides = [T_base_pivot[:3, 2] @ [0.0, 1.0, 0.0] for T_base_pivot in (plain.T_base_pivot, flipped.T_base_pivot)]
    assert sides[0] > 0.9
    assert sides[1] < -0.9
    assert (plain.flipped, flipped.flipped) == (False, True)


@pytest.mark.parametrize("width", [0.02, 0.045, 0.065])
def test_the_fingertips_pass_the_contacts_and_the_squeeze_is_level(width):
    config = GripperPlacementConfig()
    gripper = BeakGripper(config)
    grasp, _ = gripper.fit(contact_frame(config), width)
    tip = grasp.T_base_touch @ np.array([*STATIONARY_FACE[0, :1], 0.0, STATIONARY_FACE[0, 1], 1.0])
    assert 0.015 < tip[2] < 0.030
    assert abs(gripper.squeeze_out_angle(width)) < np.deg2rad(12)


def test_a_width_beyond_the_friction_cone_is_rejected_with_figures():
    gripper = BeakGripper()
    assert 0.075 < gripper.max_width_m < 0.095
    gripper.fit(np.eye(4), gripper.max_width_m)
    with raises(WidthError, "width") as caught:
        gripper.fit(np.eye(4), 0.100)
    assert "100 mm wide" in str(caught.value)
    assert "up to 84 mm" in str(caught.value)
    assert BeakGripper(GripperPlacementConfig(friction=0.2)).max_width_m < gripper.max_width_m - 0.005


@pytest.mark.parametrize("width", [0.0, -0.01, float("nan")])
def test_a_width_that_is_not_positive_is_rejected(width):
    with raises(WidthError, "width"):
        BeakGripper().fit(np.eye(4), width)


def test_a_deep_object_is_held_nearer_its_front_and_a_deeper_one_rejected(stator):
    config = GripperPlacementConfig()
    gripper = BeakGripper(config)
    shallow, _ = gripper.fit(contact_frame(config), 0.04, 0.02)
    deep, _ = gripper.fit(contact_frame(config), 0.04, 0.055)
    back_m = shallow.T_base_pivot[2, 3] - deep.T_base_pivot[2, 3]
    assert back_m == pytest.approx(0.020, abs=0.005)
    palm = stator[np.hypot(stator[:, 0], stator[:, 2]) < 0.034] @ deep.T_base_pivot[:3, :3].T + deep.T_base_pivot[:3, 3]
    assert palm[:, 2].max() < -0.055
    with raises(WidthError, "width"):
        gripper.fit(np.eye(4), 0.04, 0.090)


def test_the_mapping_moves_with_the_grasp():
    rng = np.random.default_rng(0)
    T = np.eye(4)
    T[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T[:3, 0] *= np.linalg.det(T[:3, :3])
    T[:3, 3] = rng.normal(size=3)
    here, there = BeakGripper().fit(np.eye(4), 0.05), BeakGripper().fit(T, 0.05)
    for a, b in zip(here, there, strict=True):
        assert inverse(T) @ b.T_base_pivot == pytest.approx(a.T_base_pivot, abs=1e-12)
        assert np.linalg.det(b.T_base_pivot[:3, :3]) == pytest.approx(1.0)


@pytest.mark.integration
@settings(max_examples=200)
@given(st.floats(1e-4, 0.2), st.floats(-0.02, 0.12))
def test_every_jaw_angle_is_inside_the_limits(width_m, front_m):
    fits = BeakGripper().fit_batch(np.eye(4)[None], np.array([width_m]), np.array([front_m]))
    for angles in (fits.jaw_open, fits.jaw_contact, fits.jaw_touch):
        assert z1.GRIPPER_OPEN <= angles[0] <= z1.GRIPPER_CLOSED
