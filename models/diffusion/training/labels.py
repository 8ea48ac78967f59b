"""Labels of grasps: ground-truth grasps of a solid, and an exact check of any grasp on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from hal.base.errors import InvalidValueError
from models.diffusion.training.grippers import AnyGripper
from models.diffusion.training.solids import Solid, distance_at, normal_at, trace
from models.diffusion.training.z1_gripper import GRIPPER_FIT, Z1GripperSpec, check_z1_grasps

_GRIPPER_FIT = np.array(GRIPPER_FIT)
_SAME_CONTACT_M = 0.0015  # a pad touches all points that it would reach within this distance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraspCheck:
    """Result of the exact check of some grasps."""

    free: np.ndarray
    """(N,) bool, the open gripper touches nothing."""
    antipodal: np.ndarray
    """(N,) bool, both pads of a free gripper touch, each within the friction cone."""
    widths_m: np.ndarray
    """(N,) distance between the contacts [m]; NaN where a pad touches nothing or the gripper is not free."""
    offsets_m: np.ndarray
    """(N,) position of the contacts' middle from the grasp's origin along y [m]; NaN as above."""

    @property
    def valid(self) -> np.ndarray:
        """(N,) bool, free and antipodal."""
        return self.free & self.antipodal

    def __getitem__(self, index: np.ndarray | slice) -> GraspCheck:
        """Return the results of the grasps at `index`."""
        return GraspCheck(
            free=self.free[index],
            antipodal=self.antipodal[index],
            widths_m=self.widths_m[index],
            offsets_m=self.offsets_m[index],
        )


def check_grasps(
    solid: Solid,
    T: np.ndarray,
    gripper: AnyGripper,
    widths_m: np.ndarray | None = None,
    *,
    clearance_m: float = 0.0,
    cone_rad: float | None = None,
) -> GraspCheck:
    """Check whether the grasps `T` (N, 4, 4) in the solid's frame hold.

    Args:
        solid: the true object.
        T: poses in the grasp frame (z approach, y closing).
        gripper: sizes and friction.
        widths_m: (N,) stated widths, around which the Z1 gripper is fitted; not used for a parallel gripper.
        clearance_m: free space around the open gripper.
        cone_rad: maximum angle between closing line and contact normal; the gripper's friction cone if None.

    Raises:
        InvalidValueError: the gripper is the Z1's, and no widths are given.
    """
    cone = float(np.arctan(gripper.friction)) if cone_rad is None else cone_rad
    T = np.ascontiguousarray(T, dtype=np.float64)
    shape = (solid.parts, solid.profiles, T)
    if isinstance(gripper, Z1GripperSpec):
        if widths_m is None:
            raise InvalidValueError(
                f"Grasps of the gripper {gripper.name!r} are checked with their widths; give widths_m (N,).",
                code="widths_missing",
            )
        widths = np.ascontiguousarray(np.broadcast_to(widths_m, len(T)), dtype=np.float64)
        body = (gripper.stationary_points, gripper.moving_points)
        faces = (gripper.stationary_face_points, gripper.moving_face_points)
        free, antipodal, widths, offsets = check_z1_grasps(
            *shape, widths, *body, *faces, _GRIPPER_FIT, clearance_m, np.cos(cone)
        )
    else:
        body = (gripper.body_points(), gripper.pad_points(), gripper.max_width_m / 2.0)
        free, antipodal, widths, offsets = _check(*shape, *body, clearance_m, np.cos(cone))
    return GraspCheck(free=free, antipodal=antipodal, widths_m=widths, offsets_m=offsets)


def find_grasps(
    solid: Solid, gripper: AnyGripper, rng: np.random.Generator, n_contacts: int = 900, n_turns: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Return ground-truth grasps (N, 4, 4) of `solid` from all sides and their widths (N,) [m].

    Contacts are drawn over the surface, paired along nearly their normal, and approached from all directions square
    to the closing line. Ground truth keeps 3 mm of clearance and a cone of 17°, well within the limits of
    `check_grasps`, so that a generator's small errors still give a valid grasp.
    """
    first, closing = _draw_contacts(solid, n_contacts, rng)
    # The far finger starts at any distance outside, not beyond the object: so it also closes on walls and branches.
    start = rng.uniform(0.02, gripper.max_width_m, len(first))
    far = first + start[:, None] * closing
    outside = solid.distance(far) > 0.002
    first, closing, start, far = first[outside], closing[outside], start[outside], far[outside]
    widths = start - solid.cast(far, -closing, gripper.max_width_m)
    fits = (widths > gripper.min_width_m) & (widths < gripper.max_width_m - 0.008)
    first, closing, widths = (np.repeat(a[fits], n_turns, axis=0) for a in (first, closing, widths))
    approach = _unit(np.cross(closing, _unit(rng.normal(size=closing.shape))))
    depth = rng.uniform(gripper.min_depth_m, gripper.max_depth_m, (len(first), 1))
    T = np.tile(np.eye(4), (len(first), 1, 1))
    T[:, :3, :3] = np.stack([np.cross(closing, approach), closing, approach], axis=2)
    T[:, :3, 3] = first + 0.5 * widths[:, None] * closing + depth * approach
    check = check_grasps(solid, T, gripper, widths, clearance_m=0.003, cone_rad=0.3)
    good = check.valid & (np.abs(check.offsets_m) < 0.004)
    return T[good], check.widths_m[good]


def _draw_contacts(solid: Solid, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) on the surface and unit closing directions (N, 3) into it."""
    radius = solid.enclosing_radius()
    ray = _unit(rng.normal(size=(count, 3)))
    aim = rng.uniform(-0.8, 0.8, (count, 3)) * radius
    origin = aim - 2.5 * radius * ray
    reach = solid.cast(origin, ray, 5.0 * radius)
    hit = np.isfinite(reach)
    points = origin[hit] + reach[hit, None] * ray[hit]
    normals = solid.normals(points)
    return points, _unit(-normals + rng.normal(size=normals.shape) * np.tan(0.1))


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


@njit(cache=True)
def _is_free(parts, profiles, T, body, clearance):
    for k in range(len(body)):
        b = body[k]
        x = T[0, 0] * b[0] + T[0, 1] * b[1] + T[0, 2] * b[2] + T[0, 3]
        y = T[1, 0] * b[0] + T[1, 1] * b[1] + T[1, 2] * b[2] + T[1, 3]
        z = T[2, 0] * b[0] + T[2, 1] * b[1] + T[2, 2] * b[2] + T[2, 3]
        if distance_at(parts, profiles, x, y, z) <= clearance:
            return False
    return True


@njit(cache=True)
def _close_finger(parts, profiles, T, pads, side, half):  # noqa: PLR0917 (compiled functions take no keywords)
    """Return a finger's travel until it touches, and the cosine of its contact's normal to the closing line."""
    cx, cy, cz = -side * T[0, 1], -side * T[1, 1], -side * T[2, 1]
    reach = np.empty(len(pads))
    origins = np.empty((len(pads), 3))
    for k in range(len(pads)):
        for i in range(3):
            origins[k, i] = T[i, 0] * pads[k, 0] + T[i, 1] * side * half + T[i, 2] * pads[k, 1] + T[i, 3]
        reach[k] = trace(parts, profiles, origins[k, 0], origins[k, 1], origins[k, 2], cx, cy, cz, 2.0 * half)
    nearest = reach.min()
    if not nearest < 2.0 * half:
        return np.inf, 0.0
    sx, sy, sz = 0.0, 0.0, 0.0
    for k in range(len(pads)):
        if reach[k] < nearest + _SAME_CONTACT_M:
            r, o = reach[k], origins[k]
            nx, ny, nz = normal_at(parts, profiles, o[0] + r * cx, o[1] + r * cy, o[2] + r * cz)
            sx, sy, sz = sx + nx, sy + ny, sz + nz
    norm = np.sqrt(sx * sx + sy * sy + sz * sz) + 1e-12
    return nearest, -(sx * cx + sy * cy + sz * cz) / norm


@njit(cache=True)
def _check(parts, profiles, T, body, pads, half, clearance, cos_cone):  # noqa: PLR0917
    n = len(T)
    free, antipodal = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    widths, offsets = np.full(n, np.nan), np.full(n, np.nan)
    for i in range(n):
        free[i] = _is_free(parts, profiles, T[i], body, clearance)
        if not free[i]:
            continue
        left, cos_left = _close_finger(parts, profiles, T[i], pads, 1.0, half)
        if left == np.inf:
            continue
        right, cos_right = _close_finger(parts, profiles, T[i], pads, -1.0, half)
        # Fingers that meet have nothing between them
        if right == np.inf or left + right >= 2.0 * half:
            continue
        widths[i], offsets[i] = 2.0 * half - left - right, 0.5 * (right - left)
        antipodal[i] = cos_left > cos_cone and cos_right > cos_cone
    return free, antipodal, widths, offsets
