"""Shape of the Z1, coarse enough for 500 Hz checks: capsules for the links, points for gripper and camera."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.base import z1


class Capsule(NamedTuple):
    """All points within `radius_m` of a segment, in the frame of `link`."""

    link: str
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius_m: float


CAPSULES = (
    Capsule("link00", (0.0, 0.0, 0.0), (0.0, 0.0, 0.020), 0.060),
    Capsule("link01", (0.0, -0.033, 0.033), (0.0, 0.033, 0.033), 0.040),
    Capsule("link02", (-0.350, 0.0, 0.0), (0.0, 0.0, 0.0), 0.030),
    Capsule("link02", (-0.350, -0.028, 0.0), (-0.350, 0.028, 0.0), 0.037),
    Capsule("link02", (0.0, -0.028, 0.0), (0.0, 0.028, 0.0), 0.037),
    Capsule("link03", (0.0, -0.010, 0.0), (0.060, -0.010, 0.055), 0.036),
    Capsule("link03", (0.050, 0.0, 0.055), (0.218, 0.0, 0.055), 0.034),
    Capsule("link03", (0.218, -0.016, 0.055), (0.218, 0.0, 0.055), 0.036),
    Capsule("link04", (0.0, 0.0, 0.0), (0.070, 0.0, 0.0), 0.040),
    Capsule("link05", (0.0, 0.0, 0.0), (0.030, 0.0, 0.0), 0.040),
)
"""Fitted to the collision meshes; mesh points protrude by at most 10 mm (a test measures it)."""

_MEET = {
    "link03": ("link00", "link01"),
    "link04": ("link00", "link01", "link02"),
    "link05": ("link00", "link01", "link02"),
}
CAPSULE_PAIRS = np.array(
    [
        (i, j)
        for i, one in enumerate(CAPSULES)
        for j, other in enumerate(CAPSULES)
        if other.link in _MEET.get(one.link, ())
    ]
)
"""(P, 2) indices of the capsules that can meet; neighbours on the chain always touch."""
CAPSULE_PAIRS.setflags(write=False)
TABLE_LINKS = ("link02", "link03", "link04", "link05")
"""Links that can reach the table."""
GRIPPER_OBSTACLES = ("link00", "link01", "link02", "link03")
"""Links that gripper and camera can reach."""


def _edges(*outline: tuple[float, float, float]) -> np.ndarray:
    """Return both ends of the edges at (x, z) that reach to ±y, from rows (x, z, y) [m]."""
    return np.array([(x, side * y, z) for x, z, y in outline for side in (-1.0, 1.0)])


def _gripper_points() -> np.ndarray:
    tip, palm = [(0.100, -0.009, 0.031), (0.095, -0.024, 0.031)], [(0.0, -0.036, 0.041), (0.0, 0.033, 0.041)]
    jaw = _edges(*tip, (0.070, -0.034, 0.037), *palm)
    T_pivot_camera = np.linalg.inv(z1.T_FLANGE_PIVOT) @ z1.T_FLANGE_CAMERA
    corners = np.array(np.meshgrid(*zip(z1.CAMERA_HOUSING_LOW, z1.CAMERA_HOUSING_HIGH, strict=True))).reshape(3, -1).T
    points = np.concatenate([jaw, corners @ T_pivot_camera[:3, :3].T + T_pivot_camera[:3, 3]])
    points.setflags(write=False)
    return points


GRIPPER_POINTS = _gripper_points()
"""(18, 3) corners of fixed jaw and camera housing, in the pivot frame [m] (STL meshes, `hal.base.z1`)."""
MOVING_JAW_POINTS = _edges((0.100, -0.009, 0.031), (0.100, 0.008, 0.031), (0.080, 0.020, 0.036), (0.040, 0.026, 0.041))
"""(8, 3) corners of the moving jaw, in the pivot frame when it is closed [m] (STL mesh)."""
MOVING_JAW_POINTS.setflags(write=False)
