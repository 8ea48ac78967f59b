"""Width estimates on a pillar of known measures."""

from __future__ import annotations

import numpy as np
import pytest

from z1_runtime.grasping.width_estimation import estimate_widths, expand_for_occlusion, measure_support

RADIUS_M, DEPTH_M = 0.03, 0.012


def pillar(bearings_deg: tuple[float, float] = (0.0, 360.0), height_m: float = 0.1) -> np.ndarray:
    """Return points of an upright pillar at the origin, observed between two bearings; 180° faces the gripper."""
    bearing, z = np.meshgrid(np.deg2rad(np.arange(*bearings_deg, 3.0)), np.arange(-0.5, 0.5, 0.02) * height_m)
    return np.stack([RADIUS_M * np.cos(bearing), RADIUS_M * np.sin(bearing), z], axis=-1).reshape(-1, 3)


def frontal(y_m: float = 0.0) -> np.ndarray:
    """Return a grasp that comes along +x and closes along y, its contacts' middle at (0, y, 0)."""
    T = np.eye(4)
    T[:3, :3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    T[:3, 3] = [DEPTH_M, y_m, 0.0]
    return T[None]


def test_a_width_that_is_not_known_is_measured():
    estimate = estimate_widths(frontal(), np.array([np.nan]), pillar(), DEPTH_M)
    assert estimate.widths_m == pytest.approx([2 * RADIUS_M], abs=1e-3)
    assert np.isnan(estimate_widths(frontal(0.5), np.array([np.nan]), pillar(), DEPTH_M).widths_m).all()


def test_the_front_reaches_a_radius_towards_the_palm_and_the_pads_are_filled():
    widths = np.array([2 * RADIUS_M])
    estimate = estimate_widths(frontal(), widths, pillar(), DEPTH_M)
    assert estimate.fronts_m == pytest.approx([RADIUS_M], abs=1e-3)
    assert measure_support(frontal(), widths, pillar(), DEPTH_M) == pytest.approx([1.0], abs=0.05)
    assert estimate.shifts_m == pytest.approx([0.0], abs=1e-3)


def test_a_short_object_fills_little_of_the_pads():
    support = measure_support(frontal(), np.array([2 * RADIUS_M]), pillar(height_m=0.012), DEPTH_M)
    assert support[0] < 0.7


def test_an_assumed_contact_supports_nothing():
    observed = pillar()[pillar()[:, 1] > -0.5 * RADIUS_M]
    one_side = measure_support(frontal(), np.array([2 * RADIUS_M]), observed, DEPTH_M)
    assumed = measure_support(frontal(-0.015), np.array([2 * RADIUS_M + 0.030]), observed, DEPTH_M)
    neither = measure_support(frontal(), np.array([2 * RADIUS_M + 0.030]), observed, DEPTH_M)
    assert one_side == pytest.approx([1.0], abs=0.05)
    assert assumed == pytest.approx([1.0], abs=0.05)
    assert neither[0] < 0.2


def test_points_found_after_a_shift_shift_the_centre_again():
    y, z = np.meshgrid(np.arange(-RADIUS_M, RADIUS_M, 0.001), np.arange(-0.02, 0.02, 0.002))
    face = np.column_stack([np.zeros(y.size), y.ravel(), z.ravel()])
    estimate = estimate_widths(frontal(-0.010), np.array([2 * RADIUS_M]), face, DEPTH_M)
    assert estimate.widths_m == pytest.approx([2 * RADIUS_M], abs=2e-3)
    assert estimate.shifts_m == pytest.approx([0.010], abs=2e-3)


@pytest.mark.parametrize("offset_m", [-0.003, 0.003])
def test_a_grasp_off_the_centre_gets_its_offset(offset_m):
    estimate = estimate_widths(frontal(offset_m), np.array([2 * RADIUS_M]), pillar(), DEPTH_M)
    assert estimate.shifts_m == pytest.approx([-offset_m], abs=1e-3)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_an_unobserved_contact_is_assumed_farther_out(side):
    observed = pillar()[pillar()[:, 1] * side < 0.2 * RADIUS_M]
    estimate = estimate_widths(frontal(), np.array([2 * RADIUS_M]), observed, DEPTH_M, occluded_margin_m=0.004)
    assert estimate.widths_m == pytest.approx([2 * RADIUS_M + 0.004], abs=1e-3)
    assert estimate.shifts_m == pytest.approx([side * 0.002], abs=1e-3)


def test_a_grasp_expands_on_the_side_where_the_object_may_continue():
    occluded = np.array([[0.0, -0.042, 0.0], [0.0, -0.035, 0.0], [0.0, -0.5, 0.0]])
    T, widths = expand_for_occlusion(frontal(), np.array([2 * RADIUS_M]), occluded, DEPTH_M)
    assert widths == pytest.approx([RADIUS_M + 0.042])
    assert T[0, :3, 3] == pytest.approx([DEPTH_M, -0.006, 0.0])
    same, as_before = expand_for_occlusion(frontal(), np.array([2 * RADIUS_M]), np.zeros((0, 3)), DEPTH_M)
    assert same == pytest.approx(frontal())
    assert as_before == pytest.approx([2 * RADIUS_M])
