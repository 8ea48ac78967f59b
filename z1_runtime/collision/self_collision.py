"""Contacts of the arm, whose links are capsules, with the table and with itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from hal.base import z1
from hal.base.z1 import CAPSULE_PAIRS, CAPSULES, GRIPPER_OBSTACLES, TABLE_LINKS, moving_jaw_pose
from hal.servo.guard import segment_distance, squared_distance
from z1_runtime.geometry.gripper_geometry import gripper_shape
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.types import Plane, PlanningStage, Rejection, RejectionReason

MAY_MEET_SCENE = np.array([c.link in TABLE_LINKS for c in CAPSULES])
"""(C,) capsules that can reach the table or the objects on it."""
_OBSTACLES = np.array([c.link in GRIPPER_OBSTACLES for c in CAPSULES])
_RADII = np.array([c.radius_m for c in CAPSULES])
_ENDS = np.array([[c.start, c.end] for c in CAPSULES])
_SELF_VERTICES = 400  # first of the gripper's points, tried against capsules that exceed their links by up to 10 mm


@dataclass(frozen=True, slots=True, eq=False)
class ArmPoses:
    """Poses of the arm's parts at N joint vectors, all in base."""

    links: np.ndarray
    """(N, C, 4, 4) T_base_link of every capsule's link."""
    pivots: np.ndarray
    """(N, 4, 4) T_base_pivot."""
    jaws: np.ndarray
    """(N, 4, 4) T_base_jaw of the moving jaw."""

    @classmethod
    def at(cls, kinematics: Kinematics, q: np.ndarray) -> ArmPoses:
        """Return the poses at joints `q` (N, 7) [rad]."""
        links, pivots = np.empty((len(q), len(CAPSULES), 4, 4)), np.empty((len(q), 4, 4))
        for n, joints in enumerate(q):
            poses = kinematics.link_poses(joints)
            for c, capsule in enumerate(CAPSULES):
                links[n, c] = poses[capsule.link]
            pivots[n] = poses["link06"] @ z1.T_FLANGE_PIVOT
        return cls(links, pivots, pivots @ moving_jaw_pose(q[:, -1]))


def check_arm(poses: ArmPoses, table: Plane, link_margin_m: float, stage: PlanningStage) -> Rejection | None:
    """Return the first contact of the links, at any of the poses, with the table or the arm itself, or None.

    Args:
        poses: of the arm.
        table: in the base frame.
        link_margin_m: minimum height of a link over it [m].
        stage: step of the pick that the rejection names.
    """
    links = poses.links
    ends = np.einsum("ncij,cej->ncei", links[..., :3, :3], _ENDS) + links[:, :, None, :3, 3]  # (N, C, 2, 3)
    heights = (ends @ table.normal - table.offset_m).min(axis=2) - _RADII
    heights[:, ~MAY_MEET_SCENE] = np.inf
    if (heights < link_margin_m).any():
        n, c = np.unravel_index(heights.argmin(), heights.shape)
        detail = (
            f"{CAPSULES[c].link} would be {heights[n, c] * 1e3:.0f} mm above the table; "
            f"allowed is {link_margin_m * 1e3:.0f} mm."
        )
        return Rejection(reason=RejectionReason.TABLE, stage=stage, detail=detail)
    one, other = _first_capsule_pair(ends, _RADII, CAPSULE_PAIRS)
    if one >= 0:
        detail = f"{CAPSULES[one].link} would hit {CAPSULES[other].link}."
        return Rejection(reason=RejectionReason.SELF, stage=stage, detail=detail)
    # Contiguous, the layout that `warm_up` has compiled
    obstacles = np.ascontiguousarray(ends[:, _OBSTACLES])
    shape = gripper_shape()
    parts = (("gripper or camera", poses.pivots, shape.fixed), ("the moving jaw", poses.jaws, shape.moving_jaw))
    for part, T, vertices in parts:
        c = _first_capsule_hit(T, vertices[:_SELF_VERTICES], obstacles, _RADII[_OBSTACLES])
        if c >= 0:
            link = [capsule.link for capsule in CAPSULES if capsule.link in GRIPPER_OBSTACLES][c]
            return Rejection(reason=RejectionReason.SELF, stage=stage, detail=f"{part} would hit {link}.")
    return None


def warm_up() -> None:
    """Load compiled kernels, so that the first check is as fast as the next."""
    # Read-only arrays, as the gripper's are, are a type of their own to Numba
    pose, read_only = np.eye(4)[None], gripper_shape().fixed[:1]
    ends = np.array([[[(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]]])
    _first_capsule_hit(pose, read_only, ends, np.zeros(1))
    _first_capsule_pair(ends, np.zeros(1), np.zeros((1, 2), dtype=np.int64))


@njit(cache=True, nogil=True)
def _first_capsule_hit(T, vertices, ends, radii):
    """Return the first capsule (index) that contains any of `vertices`, moved by `T[n]`, at pose n, or −1."""
    p = np.empty(3)
    for n in range(T.shape[0]):
        for v in range(vertices.shape[0]):
            for i in range(3):
                p[i] = T[n, i, 3]
                for j in range(3):
                    p[i] += T[n, i, j] * vertices[v, j]
            for c in range(radii.shape[0]):
                if squared_distance(p, ends[n, c, 0], ends[n, c, 1]) < radii[c] ** 2:
                    return c
    return -1


@njit(cache=True, nogil=True)
def _first_capsule_pair(ends, radii, pairs):
    """Return the first two capsules of `pairs` that overlap at any pose, or (−1, −1)."""
    for n in range(ends.shape[0]):
        for k in range(pairs.shape[0]):
            one, other = pairs[k, 0], pairs[k, 1]
            gap = segment_distance(ends[n, one, 0], ends[n, one, 1], ends[n, other, 0], ends[n, other, 1])
            if gap < radii[one] + radii[other]:
                return one, other
    return -1, -1
