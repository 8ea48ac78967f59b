"""Width, depth and pad support of the object at each grasp, estimated from its points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hal.base.z1 import PAD_HALF_WIDTH_M

_PALM_HALF_WIDTH_M = 0.041
_FRONT_MARGIN_M = 0.005  # points this far outside the width still move towards the palm between the jaws
_FRONT_QUANTILE = 0.01  # of the points between the jaws: a single speckle must not push the whole gripper back
_EDGE_QUANTILE = 0.01  # of the points between the pads, for the same reason
_OBSERVED_M = 0.005  # a contact with no point within this is unobserved
_MAX_SHIFT_M = 0.006  # a larger protrusion is no error of the centre
_MAX_SHIFTS, _MIN_SHIFT_M = 3, 0.001  # the centre is estimated again while it still moves by this much
_WIDTH_Z_M, _WIDTH_Y_M = 0.025, 0.06  # region along the approach and the opening that gives an unknown width
_PAD_Z_M = 0.012  # half length, along the approach, of the part of a pad that presses
_STRIPS = 5  # across a pad's width; each counts a fifth of the support
_STRIP_GAP_M = 0.008  # a strip at this gap from its pad supports nothing
_OCCLUDED_Z_M, _OCCLUDED_Y_M = 0.020, 0.025  # region beyond a contact in which occluded points widen the grasp


class WidthEstimate(NamedTuple):
    """Estimates for N grasps; z is measured from the contacts' midpoint, not from the grasp's origin."""

    widths_m: np.ndarray
    """(N,) as given, or more where more is observed; where it was NaN, twice the farthest point between the pads, NaN
    where there is none [m]."""
    fronts_m: np.ndarray
    """(N,) extent of the object towards the palm [m]."""
    shifts_m: np.ndarray
    """(N,) offset along y that centres the grasp on the points between its pads [m]."""


def estimate_widths(
    T_base_grasps: np.ndarray,
    widths_m: np.ndarray,
    points: np.ndarray,
    contact_depth_m: float,
    occluded_margin_m: float = 0.0,
) -> WidthEstimate:
    """Measure the object's `points` (M, 3) in the frames of grasps (N, 4, 4) with `widths_m` (N,), NaN = not known.

    Args:
        T_base_grasps: z approach, y opening.
        widths_m: distance between the contacts [m].
        points: in the base frame [m].
        contact_depth_m: distance of the grasps' origins beyond their contacts [m].
        occluded_margin_m: added at each contact without an observed point near it [m].
    """
    T, widths, cloud = (np.ascontiguousarray(array, dtype=np.float64) for array in (T_base_grasps, widths_m, points))
    return WidthEstimate(*_estimate(T, widths, cloud, contact_depth_m, occluded_margin_m))


def measure_support(
    T_base_grasps: np.ndarray, widths_m: np.ndarray, points: np.ndarray, contact_depth_m: float
) -> np.ndarray:
    """Return the ratio (N,) of the pads' width, in [0, 1], along which a point is observed where a pad will press.

    A contact assumed on an unobserved side supports nothing. Arguments as in `estimate_widths`.
    """
    T, widths, cloud = (np.ascontiguousarray(array, dtype=np.float64) for array in (T_base_grasps, widths_m, points))
    return _support(T, widths, cloud, contact_depth_m)


def expand_for_occlusion(
    T_base_grasps: np.ndarray, widths_m: np.ndarray, occluded_points: np.ndarray, contact_depth_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return grasps (N, 4, 4) and widths (N,) that enclose the occluded part of the object as well.

    Where `occluded_points` (K, 3) continue beyond a contact, the width grows to that side and the grasp moves half as
    much.
    """
    low, high = -0.5 * widths_m, 0.5 * widths_m
    if len(occluded_points):
        T, widths, cloud = (
            np.ascontiguousarray(array, np.float64) for array in (T_base_grasps, widths_m, occluded_points)
        )
        below, above = _occluded_extent(T, widths, cloud, contact_depth_m)
        low, high = np.fmin(low, below), np.fmax(high, above)
    moved = T_base_grasps.copy()
    moved[:, :3, 3] += (0.5 * np.nan_to_num(low + high))[:, None] * T_base_grasps[:, :3, 1]
    return moved, high - low


@njit(cache=True)
def _local(T, p, contact_depth_m):
    dx, dy, dz = p[0] - T[0, 3], p[1] - T[1, 3], p[2] - T[2, 3]
    x = dx * T[0, 0] + dy * T[1, 0] + dz * T[2, 0]
    y = dx * T[0, 1] + dy * T[1, 1] + dz * T[2, 1]
    z = dx * T[0, 2] + dy * T[1, 2] + dz * T[2, 2]
    return x, y, z + contact_depth_m


@njit(cache=True)
def _estimate(T, given, points, contact_depth_m, occluded_margin_m):  # noqa: PLR0912 - one pass over all points for each grasp
    n = len(T)
    widths, fronts, shifts = given.copy(), np.zeros(n), np.zeros(n)
    local, between, across = np.empty((len(points), 3)), np.empty(len(points)), np.empty(len(points))
    for g in range(n):
        widest = np.nan
        for m in range(len(points)):
            x, y, z = _local(T[g], points[m], contact_depth_m)
            local[m, 0], local[m, 1], local[m, 2] = x, y, z
            at_jaws = abs(x) < _PALM_HALF_WIDTH_M and abs(z) < _WIDTH_Z_M and abs(y) < _WIDTH_Y_M
            if at_jaws and not abs(y) <= widest:
                widest = abs(y)
        if np.isnan(widths[g]):
            widths[g] = 2.0 * widest
        half, shift, low, high = 0.5 * widths[g], 0.0, np.nan, np.nan
        for _ in range(_MAX_SHIFTS):
            count = 0
            for m in range(len(points)):
                x, y, z = local[m]
                if abs(x) < PAD_HALF_WIDTH_M and abs(z) < _PAD_Z_M and abs(y - shift) < half + _MAX_SHIFT_M:
                    across[count] = y
                    count += 1
            if not count:
                break
            ordered = np.sort(across[:count])
            skipped = int(_EDGE_QUANTILE * count)
            low, high = ordered[skipped], ordered[count - 1 - skipped]
            half = max(half, 0.5 * (high - low))
            moved_m = max(high - shift - half, 0.0) - max(shift - half - low, 0.0)
            shift += moved_m
            if abs(moved_m) < _MIN_SHIFT_M:
                break
        if not np.isnan(low):
            above = occluded_margin_m * (high < shift + half - _OBSERVED_M)
            below = occluded_margin_m * (low > shift - half + _OBSERVED_M)
            half += 0.5 * (above + below)
            widths[g], shifts[g] = 2.0 * half, shift + 0.5 * (above - below)
        count = 0
        for m in range(len(points)):
            x, y, z = local[m]
            if abs(x) < _PALM_HALF_WIDTH_M and abs(y - shifts[g]) < half + _FRONT_MARGIN_M:
                between[count] = z
                count += 1
        if count:
            nearest = np.sort(between[:count])[int(_FRONT_QUANTILE * count)]
            fronts[g] = max(-nearest, 0.0)
    return widths, fronts, shifts


@njit(cache=True)
def _support(T, widths, points, contact_depth_m):
    support = np.zeros(len(T))
    for g in range(len(T)):
        half, strips = 0.5 * widths[g], np.full(_STRIPS, -1.0)
        for m in range(len(points)):
            x, y, z = _local(T[g], points[m], contact_depth_m)
            if abs(x) < PAD_HALF_WIDTH_M and abs(z) < _PAD_Z_M:
                strip = int((x / PAD_HALF_WIDTH_M + 1.0) / 2.0 * _STRIPS)
                strips[strip] = max(strips[strip], min(abs(y), half))
        for strip in range(_STRIPS):
            if strips[strip] >= 0.0:
                support[g] += max(1.0 - (half - strips[strip]) / _STRIP_GAP_M, 0.0) / _STRIPS
    return support


@njit(cache=True)
def _occluded_extent(T, widths, points, contact_depth_m):
    low, high = np.full(len(T), np.nan), np.full(len(T), np.nan)
    for g in range(len(T)):
        reach = 0.5 * widths[g] + _OCCLUDED_Y_M
        for m in range(len(points)):
            x, y, z = _local(T[g], points[m], contact_depth_m)
            if abs(x) < PAD_HALF_WIDTH_M and abs(z) < _OCCLUDED_Z_M and abs(y) < reach:
                if not y >= low[g]:
                    low[g] = y
                if not y <= high[g]:
                    high[g] = y
    return low, high


def warm_up() -> None:
    """Load compiled kernels, so that the first estimate is as fast as the next."""
    one = np.eye(4)[None]
    estimate_widths(one, np.array([0.05]), np.zeros((1, 3)), 0.0)
    measure_support(one, np.array([0.05]), np.zeros((1, 3)), 0.0)
    expand_for_occlusion(one, np.array([0.05]), np.zeros((1, 3)), 0.0)
