"""Grasps of one scene, fitted to the gripper once, in the order in which the planner tries them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from models.obb.obb import OrientedBox
from models.types import GraspSet
from z1_runtime.collision.planning_scene import PlanningScene
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.grasping.beak_gripper import BeakGripper, GripperPlacement, make_placement
from z1_runtime.grasping.gripper_fits import LazyFits
from z1_runtime.types import Rejection, RejectionReason

EARLY_EXIT_CHUNK = 48
"""Grasps fitted at once where the planner may stop at the first; where all are ranked, all are fitted at once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Placements:
    """Collision-free placements of the gripper on one candidate, or the rejection of all."""

    placements: tuple[GripperPlacement, ...] = ()
    rejection: Rejection | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraspCandidates:
    """M grasps in the order of trial; another order of the same grasps shares their fits."""

    scene: PlanningScene
    grasps: GraspSet
    """(M) in the camera frame, first to try first."""
    upright_box: OrientedBox | None
    """Upright box of the object in the camera frame, where the ranking has fitted one."""
    fits: LazyFits
    """Of the grasps in their first order."""
    order: np.ndarray
    """(M,) rows of the grasps in `fits`."""

    @classmethod
    def from_grasps(
        cls,
        grasps: GraspSet,
        checker: CollisionChecker,
        gripper: BeakGripper,
        *,
        fallback_width_m: float,
        upright_box: OrientedBox | None = None,
        chunk: int | None = None,
    ) -> GraspCandidates:
        """Return `grasps` (camera frame) as candidates in `checker`'s scene.

        Args:
            grasps: first to try first.
            checker: of the scene.
            gripper: fitted to each of them.
            fallback_width_m: where neither the generator nor the cloud gives a width [m].
            upright_box: of the object, where it is known already.
            chunk: grasps that are fitted at once; None fits all of them.
        """
        return cls(
            scene=checker.scene,
            grasps=grasps,
            upright_box=upright_box,
            fits=LazyFits(grasps, gripper, checker, fallback_width_m, len(grasps) if chunk is None else chunk),
            order=np.arange(len(grasps)),
        )

    def __len__(self) -> int:
        return len(self.order)

    def reordered(self, order: np.ndarray) -> GraspCandidates:
        """Return candidates `order` (K,) of these, in that order, without fitting them again."""
        return replace(self, grasps=self.grasps[order], order=self.order[order])

    @property
    def contacts(self) -> np.ndarray:
        """(M, 3) midpoint between the contacts, in the base frame [m]."""
        T = self.fits.T_base_grasps[self.order]
        return T[:, :3, 3] - self.fits.gripper.config.contact_depth_m * T[:, :3, 2]

    @property
    def approaches(self) -> np.ndarray:
        """(M, 3) unit vectors of the approach, in the base frame."""
        return self.grasps.T_camera_grasps[:, :3, 2] @ self.scene.T_base_camera[:3, :3].T

    @property
    def widths_m(self) -> np.ndarray:
        """(M,) object widths: measured where the candidate is fitted, else as the generator gave them [m]."""
        return self.fits.widths_m[self.order]

    @property
    def support(self) -> np.ndarray:
        """(M,) ratio of the pads that the observed object fills, in [0, 1]; fits the candidates."""
        self.fits.fit(self.order)
        return self.fits.support[self.order]

    @property
    def level(self) -> np.ndarray:
        """(M,) 1 where the jaws' push is level, 0 where friction just holds; fits the candidates."""
        self.fits.fit(self.order)
        return self.fits.level[self.order]

    def free(self) -> np.ndarray:
        """Return (M,) whether a flip of each candidate hits nothing at the grasp."""
        return np.array([self.placements(rank).rejection is None for rank in range(len(self))], dtype=bool)

    def placements(self, rank: int) -> Placements:
        """Return the flips of candidate `rank` that hit nothing at the grasp, or the rejection of both."""
        index = int(self.order[rank])
        fits, row, contacts = self.fits.get(index)
        T_base_grasp, width_m = self.fits.T_base_grasps[index], float(self.fits.widths_m[index])
        # A gripper under the table is the finding, whatever else keeps it from fitting
        at_table = [contact for contact in contacts if contact and contact.reason is RejectionReason.TABLE]
        if len(at_table) == len(contacts):
            return Placements(rejection=replace(at_table[0], rank=rank))
        if not fits.fits[row]:
            rejection = self.fits.gripper.reject_width(width_m, float(self.fits.fronts_m[index]))
            return Placements(rejection=replace(rejection, rank=rank))
        # The pivot's +y carries the camera: above the gripper it is clear of the table and sees the object
        camera_up_first = (0, 1) if T_base_grasp[2, 0] >= 0.0 else (1, 0)
        free = [flip for flip in camera_up_first if contacts[flip] is None]
        first = contacts[camera_up_first[0]]
        if not free and first is not None:
            return Placements(rejection=replace(first, rank=rank))
        return Placements(placements=tuple(make_placement(fits, row, flip, T_base_grasp, width_m) for flip in free))
