"""Candidates are measured where they are placed, and fitted once whatever their order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.tabletop_scenes import camera_pose, frontal, in_camera, make_candidates, make_observation
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.beak_gripper import BeakGripper

REQUESTED_M, SLANT, RADIUS_M, HEIGHT_M = 0.50, 0.2, 0.02, 0.1


def slanted_bar(front_m: float) -> np.ndarray:
    """Return points of a horizontal bar that begins `front_m` before `REQUESTED_M` and slants by 0.2 m a metre."""
    x, angle = np.meshgrid(np.arange(REQUESTED_M - front_m, 0.58, 0.002), np.arange(0.0, 2.0 * np.pi, 0.1))
    x, angle = x.ravel(), angle.ravel()
    y = SLANT * (x - REQUESTED_M) + RADIUS_M * np.cos(angle)
    return np.column_stack([x, y, HEIGHT_M + RADIUS_M * np.sin(angle)])


@pytest.mark.parametrize("front_m", [0.020, 0.050])
def test_the_centre_is_measured_where_the_object_is_held(front_m):
    kinematics, gripper = Kinematics(), BeakGripper()
    T_base_camera = camera_pose(kinematics)
    observation = make_observation(T_base_camera, slanted_bar(front_m))
    requested = frontal(REQUESTED_M, 0.0, HEIGHT_M, 0.0, yaw_rad=0.0)
    grasps = in_camera(T_base_camera, [requested], 2.0 * RADIUS_M)
    candidates = make_candidates(kinematics, grasps, observation)
    (T,) = candidates.fits._measure(slice(0, 1))
    setback = gripper.fit_batch(T[None], candidates.widths_m, candidates.fits.fronts_m).setback_m[0]
    assert (setback > 0.010) == (front_m == 0.050)
    assert T[1, 3] == pytest.approx(-SLANT * setback, abs=1.5e-3)
    assert candidates.widths_m[0] == pytest.approx(2.0 * RADIUS_M, abs=6e-3)
    assert candidates.support[0] > 0.5  # the bar is thinner than the pads are wide


def test_another_order_shares_the_fits(monkeypatch):
    kinematics = Kinematics()
    T_base_camera = camera_pose(kinematics)
    observation = make_observation(T_base_camera, slanted_bar(0.020))
    poses = [frontal(REQUESTED_M, y, HEIGHT_M, pitch, yaw_rad=0.0) for y in (-0.02, 0.0) for pitch in (0.0, 0.5)]
    low = frontal(REQUESTED_M, 0.0, 0.0, 1.0, yaw_rad=0.0)
    candidates = make_candidates(kinematics, in_camera(T_base_camera, [*poses, low]), observation, chunk=2)
    before = [candidates.placements(rank) for rank in range(5)]
    monkeypatch.setattr(candidates.fits, "_fit", None)  # another fit would fail
    order = np.array([4, 2, 0])
    reordered = candidates.reordered(order)
    for rank, index in enumerate(order):
        after = reordered.placements(rank)
        for one, other in zip(after.placements, before[index].placements, strict=True):
            np.testing.assert_array_equal(one.T_base_pivot, other.T_base_pivot)
    rejected = before[4].rejection
    assert rejected is not None
    assert reordered.placements(0).rejection == replace(rejected, rank=0)
    assert reordered.widths_m.tolist() == candidates.widths_m[order].tolist()
    assert reordered.reordered(np.array([1])).contacts.tolist() == candidates.contacts[2:3].tolist()
