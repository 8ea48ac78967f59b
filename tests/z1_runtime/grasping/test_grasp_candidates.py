"""Where a grasp is laid is where it was measured, also when the palm has no room for it where it was asked."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.tabletop_scenes import camera_pose, frontal, in_camera, make_observation
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.beak_gripper import BeakGripper
from z1_runtime.grasping.grasp_candidates import GraspCandidates

ASKED_M, SLANT, RADIUS_M, HEIGHT_M = 0.50, 0.2, 0.02, 0.1


def slanted_bar(front_m: float) -> np.ndarray:
    """Return points of a lying bar that begins `front_m` before `ASKED_M` and runs aside by 0.2 m a metre."""
    x, angle = np.meshgrid(np.arange(ASKED_M - front_m, 0.58, 0.002), np.arange(0.0, 2.0 * np.pi, 0.1))
    x, angle = x.ravel(), angle.ravel()
    y = SLANT * (x - ASKED_M) + RADIUS_M * np.cos(angle)
    return np.column_stack([x, y, HEIGHT_M + RADIUS_M * np.sin(angle)])


@pytest.mark.parametrize("front_m", [0.020, 0.050])
def test_the_middle_is_measured_where_the_object_is_held(front_m):
    kinematics, gripper = Kinematics(), BeakGripper()
    T_base_camera = camera_pose(kinematics)
    observation = make_observation(T_base_camera, slanted_bar(front_m))
    checker = CollisionChecker(kinematics, observation, None)
    asked = frontal(ASKED_M, 0.0, HEIGHT_M, 0.0, yaw_rad=0.0)
    grasps = in_camera(T_base_camera, [asked], 2.0 * RADIUS_M)
    candidates = GraspCandidates(grasps, T_base_camera, gripper, checker, fallback_width_m=0.06)
    (T,) = candidates._measure(slice(0, 1))
    setback = gripper.fit_batch(T[None], candidates.widths_m, candidates._fronts_m).setback_m[0]
    assert (setback > 0.010) == (front_m == 0.050)
    assert T[1, 3] == pytest.approx(-SLANT * setback, abs=1.5e-3)
    assert candidates.widths_m[0] == pytest.approx(2.0 * RADIUS_M, abs=6e-3)
    assert candidates.support[0] > 0.5  # the bar is thinner than the pads are wide
