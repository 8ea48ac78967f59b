"""The robot's own jaws are masked at every opening, and nothing else with them."""

import numpy as np
import pytest

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.transforms import inverse, transform_points
from tests.support.errors import raises
from tests.support.tabletop_scene import (
    INTRINSICS,
    Box,
    Cylinder,
    T_base_camera,
    before,
    cast,
    d405,
    frame_of,
    gripper_depth,
)
from z1_runtime.perception.detector import NoDetectionError
from z1_runtime.perception.detectors.tabletop import TabletopDetector
from z1_runtime.perception.point_cloud import back_project
from z1_runtime.perception.segmentation import Perception, PerceptionConfig
from z1_runtime.perception.self_filter import SelfFilter

JAW = -1.0
BETWEEN_THE_JAWS = Box(0.32, -0.03, (0.02, 0.02, 0.30))
"""A stick that reaches into the space between the open jaws at home."""


def perceive(objects, jaw=JAW, seed=0):
    exact = before(gripper_depth(jaw), cast(objects)[0])
    return Perception(PerceptionConfig(), TabletopDetector()).observe(
        frame_of(d405(exact, seed)), T_base_camera() @ inverse(z1.T_FLANGE_CAMERA), jaw
    )


@pytest.mark.integration
@pytest.mark.parametrize("jaw", [z1.GRIPPER_OPEN, JAW, -0.4, z1.GRIPPER_CLOSED])
def test_every_pixel_of_the_gripper_is_masked_at_any_opening(jaw):
    alone = gripper_depth(jaw)
    depth = np.where(np.isfinite(alone), alone, 0.0).astype(np.float32)
    assert (depth > 0).sum() > 2000
    assert not SelfFilter().mask_gripper(frame_of(depth), jaw).depth_m.any()


def test_a_hand_eye_error_of_5_mm_is_covered():
    alone = gripper_depth(JAW)
    depth = np.where(np.isfinite(alone), alone, 0.0).astype(np.float32)
    shift = round(0.005 * INTRINSICS.fx / float(np.median(depth[depth > 0])))
    moved = np.roll(np.where(depth > 0, depth + 0.005, 0.0).astype(np.float32), shift, axis=1)
    moved[:, :shift] = 0.0
    assert (SelfFilter().mask_gripper(frame_of(moved), JAW).depth_m > 0).mean() < 1e-4


def test_an_object_between_the_open_jaws_is_kept():
    depth, which = cast([BETWEEN_THE_JAWS])
    visible = (which == 0) & ~(gripper_depth(JAW) < depth)
    flange = transform_points(z1.T_FLANGE_CAMERA, back_project(depth, INTRINSICS, visible))
    # The fingertips are 0.2 m along the flange's x; the jaws open along its z
    between = (flange[:, 0] < 0.2) & (np.abs(flange[:, 1]) < 0.02) & (flange[:, 2] > 0.0) & (flange[:, 2] < 0.08)
    assert between.sum() > 100
    kept = SelfFilter().mask_gripper(frame_of(depth.astype(np.float32)), JAW).depth_m > 0
    assert kept[visible].mean() > 0.99


def test_the_background_of_the_jaws_is_kept():
    depth = cast([])[0].astype(np.float32)
    behind = SelfFilter().mask_gripper(frame_of(depth), JAW).depth_m
    np.testing.assert_array_equal(behind, depth)


@pytest.mark.integration
def test_the_robots_own_jaws_are_neither_object_nor_scene():
    with pytest.raises(NoDetectionError):
        perceive([])
    seen = perceive([Cylinder(0.5, 0.0, 0.0325, 0.2)])
    own = gripper_depth(JAW)
    jaws = back_project(np.where(np.isfinite(own), own, 0.0), INTRINSICS, np.isfinite(own))
    for points in (seen.object_points, seen.scene_points):
        assert points[:, 2].min() > jaws[:, 2].max()


@pytest.mark.integration
def test_the_frame_that_is_shown_keeps_its_depth():
    exact = before(gripper_depth(JAW), cast([Cylinder(0.5, 0.0, 0.0325, 0.2)])[0])
    frame = frame_of(d405(exact, 0))
    seen = Perception(PerceptionConfig(), TabletopDetector()).observe(
        frame, T_base_camera() @ inverse(z1.T_FLANGE_CAMERA), JAW
    )
    assert seen.frame is frame


def test_a_margin_out_of_range_is_rejected():
    with raises(InvalidValueError, "margin"):
        SelfFilter(margin_m=0.0)
