"""Grasps of one scene, fitted to the gripper in chunks on first use, in the order in which the planner tries them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from models.obb.obb import OrientedBox
from models.types import GraspSet
from z1_runtime.collision.planning_scene import PlanningScene
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.grasping.beak_gripper import BeakGripper, GripperFits, GripperPlacement, make_placement
from z1_runtime.grasping.width_estimation import estimate_widths, expand_for_occlusion, measure_support
from z1_runtime.types import Rejection, RejectionReason

FlipRejections = tuple[Rejection | None, Rejection | None]
"""Contact of each flip at the grasp; None where it is free."""
_MAX_SHAPE_POINTS = 1000  # of the object, evenly chosen: bounds the time of the width estimates
_REFIT_THRESHOLD_M = 0.003  # a grasp that is moved further along its approach is measured again there


class LazyFits:
    """Width, gripper fit and contacts of N grasps in the base frame.

    Args:
        grasps: camera frame.
        gripper: fitted to each of them.
        checker: of the scene.
        fallback_width_m: where neither the generator nor the cloud gives a width [m].
        chunk: grasps that are fitted at once.
    """

    def __init__(
        self, grasps: GraspSet, gripper: BeakGripper, checker: CollisionChecker, fallback_width_m: float, chunk: int
    ) -> None:
        self.gripper = gripper
        self.T_base_grasps = checker.scene.T_base_camera @ grasps.T_camera_grasps
        """(N, 4, 4)"""
        n = len(grasps)
        self.widths_m = np.array(grasps.widths_m, dtype=np.float64)
        """(N,) as given, or measured in the cloud once fitted [m]."""
        self.fronts_m = np.full(n, np.nan)
        """(N,) extent of the object towards the palm, once fitted [m]."""
        self.support = np.full(n, np.nan)
        """(N,) ratio of the pads that the observed object fills, in [0, 1], once fitted."""
        self.level = np.full(n, np.nan)
        """(N,) 1 where the jaws' push is level, 0 where friction just holds, once fitted."""
        self._checker = checker
        self._fallback_width_m = fallback_width_m
        # Also without a grasp, as indices are divided by it
        self._chunk = max(1, chunk)
        points = checker.scene.object_points
        self._shape_points = points[:: max(1, len(points) // _MAX_SHAPE_POINTS)]
        self._fitted: dict[int, tuple[GripperFits, list[FlipRejections]]] = {}

    def get(self, index: int) -> tuple[GripperFits, int, FlipRejections]:
        """Return the fits that hold grasp `index`, its row there, and the contacts of its flips."""
        chunk, row = divmod(index, self._chunk)
        if chunk not in self._fitted:
            self._fitted[chunk] = self._fit(slice(chunk * self._chunk, (chunk + 1) * self._chunk))
        fits, rejections = self._fitted[chunk]
        return fits, row, rejections[row]

    def fit(self, indices: np.ndarray) -> None:
        """Fit the grasps `indices` (K,), as far as they are not fitted yet."""
        for chunk in np.unique(indices // self._chunk):
            self.get(int(chunk) * self._chunk)

    def _fit(self, part: slice) -> tuple[GripperFits, list[FlipRejections]]:
        T_base_grasps = self._measure(part)
        fits = self.gripper.fit_batch(T_base_grasps, self.widths_m[part], self.fronts_m[part])
        self.level[part] = fits.level
        hits = self._checker.check_grippers(fits.T_base_pivots.reshape(-1, 4, 4), np.repeat(fits.jaw_open, 2))
        rejections = [(hits.rejection(2 * n), hits.rejection(2 * n + 1)) for n in range(len(T_base_grasps))]
        return fits, rejections

    def _measure(self, part: slice) -> np.ndarray:
        """Measure the object at the grasps in `part`; return them (n, 4, 4), centred on the object, moved on along
        their approach, and expanded for occluded points.

        Where jaws and palm cannot hold the object at the requested place, it is measured again where they can.
        """
        Ts, given = self.T_base_grasps[part], self.widths_m[part].copy()
        T_base_grasps, widths, fronts = self._centre(Ts, given)
        deeper, setback = self._limit_depth(T_base_grasps, widths, fronts)
        offset = deeper - setback
        moved = np.abs(offset) > _REFIT_THRESHOLD_M
        if moved.any():
            there, widths[moved], _ = self._centre(_advance(Ts[moved], offset[moved]), given[moved])
            # Back to the requested depth: the offsets of all grasps are applied below
            T_base_grasps[moved] = _advance(there, -offset[moved])
        self.widths_m[part], self.fronts_m[part] = widths, fronts + deeper
        self.support[part] = measure_support(
            _advance(T_base_grasps, offset), widths, self._shape_points, self.gripper.config.contact_depth_m
        )
        return _advance(T_base_grasps, deeper)

    def _centre(self, Ts: np.ndarray, given_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return grasps (n, 4, 4) moved along y to the middle of the points between their pads, the object's width
        (n,), and its extent towards the palm (n,) [m]; widths `given_m` (n,) may be NaN."""
        config = self.gripper.config
        estimate = estimate_widths(Ts, given_m, self._shape_points, config.contact_depth_m, config.occluded_margin_m)
        widths = np.where(np.isfinite(estimate.widths_m), estimate.widths_m, self._fallback_width_m)
        centred = Ts.copy()
        centred[:, :3, 3] += estimate.shifts_m[:, None] * Ts[:, :3, 1]
        occluded = self._checker.scene.occluded_points
        return *expand_for_occlusion(centred, widths, occluded, config.contact_depth_m), estimate.fronts_m

    def _limit_depth(self, Ts: np.ndarray, widths_m: np.ndarray, fronts_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances (n,) by which grasps move on along their approach, to where the object is widest, and
        those (n,) by which they are set back for the palm [m].

        A round object reaches half its width towards the palm; where less of it is observed, the contacts are before
        its middle, and the jaws would push it out. The table bounds how far the jaws can go.
        """
        fits = self.gripper.fit_batch(Ts, widths_m, fronts_m)
        spare = self._checker.spare_height_m(fits.T_base_pivots.reshape(-1, 4, 4), np.repeat(fits.jaw_open, 2))
        # A level approach never meets the table: its clearance is large, but finite
        down = np.maximum(-Ts[:, :3, 2] @ self._checker.scene.table.normal, 1e-3)
        # Of the better flip, since either may be taken
        clearance_m = spare.reshape(-1, 2).max(axis=1) / down
        max_m = np.minimum(self.gripper.config.max_deepening_m, np.maximum(clearance_m, 0.0))
        return np.clip(0.5 * widths_m - fronts_m, 0.0, max_m), fits.setback_m


def _advance(Ts: np.ndarray, by_m: np.ndarray) -> np.ndarray:
    """Return grasps (n, 4, 4) moved along their approach by `by_m` (n,) [m]."""
    moved = Ts.copy()
    moved[:, :3, 3] += by_m[:, None] * Ts[:, :3, 2]
    return moved


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
