"""Where an object is cut off by what hides it, and where it simply ends."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base.messages import Intrinsics
from z1_runtime.perception.self_filter import REACH_M, occluded_points

INTRINSICS = Intrinsics(width=320, height=240, fx=400.0, fy=400.0, cx=159.5, cy=119.5)
OBJECT_M, TABLE_M = 0.30, 0.45
ROWS, COLUMNS = slice(80, 160), slice(120, 180)


def picture(gap: tuple[slice, slice] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return depth with an object before a table and nothing measured in `gap`, and the object's pixels."""
    depth, solid = np.full((240, 320), TABLE_M), np.zeros((240, 320), bool)
    depth[ROWS, COLUMNS] = OBJECT_M
    solid[ROWS, COLUMNS] = True
    if gap is not None:
        depth[gap] = 0.0
        solid[gap] = False
    return depth, solid


def test_an_object_in_full_view_hides_nothing():
    depth, solid = picture()
    assert occluded_points(depth, INTRINSICS, solid).shape == (0, 3)
    assert occluded_points(depth, INTRINSICS, np.zeros_like(solid)).shape == (0, 3)


def test_behind_what_hides_its_side_the_object_goes_on_at_its_depth():
    depth, solid = picture((slice(60, 200), slice(160, 230)))
    points = occluded_points(depth, INTRINSICS, solid)
    edge_m = (159 - INTRINSICS.cx) * OBJECT_M / INTRINSICS.fx
    assert points[:, 2] == pytest.approx(OBJECT_M)
    assert points[:, 0].min() == pytest.approx(edge_m, abs=2e-3)
    assert points[:, 0].max() == pytest.approx(edge_m + REACH_M, abs=2e-3)


def test_a_gap_that_the_table_separates_from_the_object_hides_nothing_of_it():
    depth, solid = picture((slice(60, 200), slice(190, 230)))
    assert occluded_points(depth, INTRINSICS, solid).shape == (0, 3)


def test_the_thin_stereo_shadow_at_an_edge_occludes_nothing():
    depth, solid = picture((ROWS, slice(180, 190)))
    assert occluded_points(depth, INTRINSICS, solid).shape == (0, 3)
