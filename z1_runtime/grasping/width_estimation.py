"""What the object's points say of each grasp: how wide it is there, how far it reaches, how much of a jaw it fills."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hal.base.z1_gripper import PAD_HALF_WIDTH_M

_PALM_HALF_WIDTH_M = 0.041
_ASIDE_M = 0.005  # what stands out this far beside the width still goes towards the palm between the jaws
_FRONT_SHARE = 0.01  # of the points between: one speckle shall not push the whole hand back
_EDGE_SHARE = 0.01
_SEEN_M = 0.005
_PUSHED_M = 0.006  # what stands out further than this is no error of the middle
_GROWTHS, _GROWN_M = 3, 0.001  # times that what then stands beside is looked at again, if the middle moved this far
_WIDTH_Z_M, _WIDTH_Y_M = 0.025, 0.06
_PAD_Z_M = 0.012
_STRIPS = 5
_STRIP_GAP_M = 0.008
_HIDDEN_Z_M, _HIDDEN_Y_M = 0.020, 0.025


class WidthEstimate(NamedTuple):
    """What the points say of N grasps; z is measured from the contacts' middle, not from the grasp's origin."""

    widths_m: np.ndarray
    """(N,) as given, or more where more is seen; where it was NaN, twice the farthest point beside the pads, NaN where
    there is none [m]."""
    fronts_m: np.ndarray
    """(N,) how far the object reaches towards the palm [m]."""
    shifts_m: np.ndarray
    """(N,) how far along y the grasp must move for its width to hold all that is seen between the pads [m]."""


def fit_grasps(
    T_base_grasps: np.ndarray, widths_m: np.ndarray, points: np.ndarray, contact_depth_m: float, unseen_m: float = 0.0
) -> WidthEstimate:
    """Measure the object's `points` (M, 3) in the frames of grasps (N, 4, 4) with `widths_m` (N,), NaN = not known.

    Args:
        T_base_grasps: z approach, y opening.
        widths_m: distance between the contacts [m].
        points: in the base frame [m].
        contact_depth_m: how far the grasps' origins lie beyond their contacts [m].
        unseen_m: how much farther out a contact is thought to be where no point is seen near it [m].
    """
    T, widths, cloud = (np.ascontiguousarray(array, dtype=np.float64) for array in (T_base_grasps, widths_m, points))
    return WidthEstimate(*_fit(T, widths, cloud, contact_depth_m, unseen_m))


def measure_support(
    T_base_grasps: np.ndarray, widths_m: np.ndarray, points: np.ndarray, contact_depth_m: float
) -> np.ndarray:
    """Return the share (N,) of the pads' width, in [0, 1], along which a point is seen where a pad will press.

    A contact that was only supposed, on a side that nothing shows, supports nothing. Arguments as in `fit_grasps`.
    """
    T, widths, cloud = (np.ascontiguousarray(array, dtype=np.float64) for array in (T_base_grasps, widths_m, points))
    return _support(T, widths, cloud, contact_depth_m)


def make_room(
    T_base_grasps: np.ndarray, widths_m: np.ndarray, hidden: np.ndarray, contact_depth_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return grasps (N, 4, 4) and widths (N,) that go around what may be there unseen as well.

    Where `hidden` (K, 3) goes on beside one contact, the width grows to that side and the grasp moves half as much.
    """
    low, high = -0.5 * widths_m, 0.5 * widths_m
    if len(hidden):
        T, widths, cloud = (np.ascontiguousarray(array, np.float64) for array in (T_base_grasps, widths_m, hidden))
        below, above = _reach_aside(T, widths, cloud, contact_depth_m)
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
def _fit(T, given, points, contact_depth_m, unseen_m):  # noqa: PLR0912 - one pass over all points for each grasp
    n = len(T)
    widths, fronts, shifts = given.copy(), np.zeros(n), np.zeros(n)
    local, between, aside = np.empty((len(points), 3)), np.empty(len(points)), np.empty(len(points))
    for g in range(n):
        widest = np.nan
        for m in range(len(points)):
            x, y, z = _local(T[g], points[m], contact_depth_m)
            local[m, 0], local[m, 1], local[m, 2] = x, y, z
            beside = abs(x) < _PALM_HALF_WIDTH_M and abs(z) < _WIDTH_Z_M and abs(y) < _WIDTH_Y_M
            if beside and not abs(y) <= widest:
                widest = abs(y)
        if np.isnan(widths[g]):
            widths[g] = 2.0 * widest
        half, shift, low, high = 0.5 * widths[g], 0.0, np.nan, np.nan
        for _ in range(_GROWTHS):
            count = 0
            for m in range(len(points)):
                x, y, z = local[m]
                if abs(x) < PAD_HALF_WIDTH_M and abs(z) < _PAD_Z_M and abs(y - shift) < half + _PUSHED_M:
                    aside[count] = y
                    count += 1
            if not count:
                break
            across = np.sort(aside[:count])
            skipped = int(_EDGE_SHARE * count)
            low, high = across[skipped], across[count - 1 - skipped]
            half = max(half, 0.5 * (high - low))
            moved = max(high - shift - half, 0.0) - max(shift - half - low, 0.0)
            shift += moved
            if abs(moved) < _GROWN_M:
                break
        if not np.isnan(low):
            above = unseen_m * (high < shift + half - _SEEN_M)
            below = unseen_m * (low > shift - half + _SEEN_M)
            half += 0.5 * (above + below)
            widths[g], shifts[g] = 2.0 * half, shift + 0.5 * (above - below)
        count = 0
        for m in range(len(points)):
            x, y, z = local[m]
            if abs(x) < _PALM_HALF_WIDTH_M and abs(y - shifts[g]) < half + _ASIDE_M:
                between[count] = z
                count += 1
        if count:
            nearest = np.sort(between[:count])[int(_FRONT_SHARE * count)]
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
def _reach_aside(T, widths, hidden, contact_depth_m):
    low, high = np.full(len(T), np.nan), np.full(len(T), np.nan)
    for g in range(len(T)):
        reach = 0.5 * widths[g] + _HIDDEN_Y_M
        for m in range(len(hidden)):
            x, y, z = _local(T[g], hidden[m], contact_depth_m)
            if abs(x) < PAD_HALF_WIDTH_M and abs(z) < _HIDDEN_Z_M and abs(y) < reach:
                if not y >= low[g]:
                    low[g] = y
                if not y <= high[g]:
                    high[g] = y
    return low, high


def warm_up() -> None:
    """Load what is compiled, so that the first fit is as fast as the next."""
    one = np.eye(4)[None]
    fit_grasps(one, np.array([0.05]), np.zeros((1, 3)), 0.0)
    measure_support(one, np.array([0.05]), np.zeros((1, 3)), 0.0)
    make_room(one, np.array([0.05]), np.zeros((1, 3)), 0.0)
