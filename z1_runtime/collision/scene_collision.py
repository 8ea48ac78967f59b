"""Collision checks of gripper poses and whole trajectories against table, scene and object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.base import z1
from hal.base.z1 import CAPSULES, moving_jaw_pose
from z1_runtime.collision import self_collision
from z1_runtime.collision.planning_scene import PlanningScene
from z1_runtime.collision.self_collision import MAY_MEET_SCENE, ArmPoses, check_arm
from z1_runtime.collision.voxel_grid import SceneIndex
from z1_runtime.geometry.gripper_geometry import gripper_shape
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.types import JointTrajectory, PlanningStage, Rejection, RejectionReason

_SURFACE_SPACING_M = 0.012  # between points on a capsule


@dataclass(frozen=True, slots=True, eq=False)
class GripperHits:
    """First contact of each of N gripper poses, in the order table, scene, object; later ones are not computed."""

    height_m: np.ndarray
    """(N,) lowest point over the table [m]."""
    scene: np.ndarray
    """(N, 3) a scene point that is hit, NaN where none is [m]."""
    object: np.ndarray
    """(N, 3) a point of the object that is hit, NaN where none is [m]."""
    table_margin_m: float
    """Minimum height allowed [m]."""

    def free(self) -> np.ndarray:
        """Return (N,) whether a pose hits nothing."""
        return (self.height_m >= self.table_margin_m) & np.isnan(self.scene[:, 0]) & np.isnan(self.object[:, 0])

    def rejection(self, n: int, stage: PlanningStage = PlanningStage.GRASP) -> Rejection | None:
        """Return the first contact of pose `n`, or None."""
        if self.height_m[n] < self.table_margin_m:
            return _reject_height(float(self.height_m[n]), self.table_margin_m, stage)
        hits = ((RejectionReason.SCENE, self.scene[n]), (RejectionReason.OBJECT, self.object[n]))
        for reason, point in hits:
            if not np.isnan(point[0]):
                return Rejection(
                    reason=reason, stage=stage, detail=f"the gripper hits the {reason} at {_format_point(point)}."
                )
        return None


class CollisionChecker:
    """Collision checks of gripper poses, postures and trajectories in one scene."""

    def __init__(self, kinematics: Kinematics, scene: PlanningScene) -> None:
        self.scene = scene
        self.config = scene.config
        self._kinematics = kinematics
        self._shape = gripper_shape()

    def check_grippers(
        self,
        T_base_pivots: np.ndarray,
        jaws: np.ndarray,
        *,
        scene_threshold_m: float | None = None,
        object_threshold_m: float | None = None,
    ) -> GripperHits:
        """Test gripper, camera and bracket at pivot poses (N, 4, 4) and jaw angles (N,) [rad].

        Args:
            T_base_pivots: (N, 4, 4).
            jaws: (N,).
            scene_threshold_m: the configured one if None [m].
            object_threshold_m: the configured one if None; negative leaves the object out [m].
        """
        config = self.config
        scene_m = config.scene_threshold_m if scene_threshold_m is None else scene_threshold_m
        object_m = config.object_threshold_m if object_threshold_m is None else object_threshold_m
        T_base_jaws = T_base_pivots @ moving_jaw_pose(jaws)
        parts = ((T_base_pivots, self._shape.fixed), (T_base_jaws, self._shape.moving_jaw))
        height = np.min([self._lowest(T, vertices) for T, vertices in parts], axis=0)
        clear = height >= config.table_margin_m
        scene = self._hits(self.scene.scene_index, parts, scene_m, clear)
        hit_object = self._hits(self.scene.object_index, parts, object_m, clear & np.isnan(scene[:, 0]))
        return GripperHits(height, scene, hit_object, config.table_margin_m)

    def spare_height_m(self, T_base_pivots: np.ndarray, jaws: np.ndarray) -> np.ndarray:
        """Return the distances (N,) by which the gripper can descend at poses (N, 4, 4) and jaw angles (N,) [m]."""
        return self._heights(T_base_pivots, jaws) - self.config.table_margin_m

    def check_posture(self, q: np.ndarray) -> Rejection | None:
        """Return the contact of the arm at `q` (7,) with the table or itself, or None."""
        poses = ArmPoses.at(self._kinematics, q[None])
        return check_arm(poses, self.scene.table, self.config.link_margin_m, PlanningStage.IK)

    def check_trajectory(
        self,
        trajectory: JointTrajectory,
        *,
        threshold_m: float,
        object_threshold_m: float = -1.0,
        stage: PlanningStage = PlanningStage.TRANSFER,
    ) -> Rejection | None:
        """Return the first contact along `trajectory`, or None.

        Args:
            trajectory: sampled every `sample_s`, its end included.
            threshold_m: distance from a scene point that counts as a contact [m].
            object_threshold_m: the same for the object; negative leaves it out, as when it is held [m].
            stage: step of the pick that the rejection names.
        """
        q = self._samples(trajectory)
        poses = ArmPoses.at(self._kinematics, q)
        rejection = check_arm(poses, self.scene.table, self.config.link_margin_m, stage)
        if rejection is not None:
            return rejection
        hits = self.check_grippers(
            poses.pivots, q[:, -1], scene_threshold_m=threshold_m, object_threshold_m=object_threshold_m
        )
        blocked = ~hits.free()
        if blocked.any():
            return hits.rejection(int(blocked.argmax()), stage)
        return self._check_links(poses.links, stage)

    def check_closing(self, trajectory: JointTrajectory) -> Rejection | None:
        """Return the gripper's first contact with the table along `trajectory`, or None; all else it may touch."""
        q = self._samples(trajectory)
        lowest_m = float(self._heights(ArmPoses.at(self._kinematics, q).pivots, q[:, -1]).min())
        if lowest_m >= self.config.closing_margin_m:
            return None
        return _reject_height(lowest_m, self.config.closing_margin_m, PlanningStage.CLOSE)

    def _samples(self, trajectory: JointTrajectory) -> np.ndarray:
        step = max(1, round(self.config.sample_s / z1.CONTROL_PERIOD_S))
        return np.concatenate([trajectory.q[:-1:step], trajectory.q[-1:]])

    def _check_links(self, links: np.ndarray, stage: PlanningStage) -> Rejection | None:
        index = self.scene.scene_index
        for c, capsule in enumerate(CAPSULES):
            if not MAY_MEET_SCENE[c]:
                continue
            _, hit = index.first_hits(links[:, c], _LINK_SURFACES[c], self.config.transfer_threshold_m)
            if (hit >= 0).any():
                point = _format_point(index.points[hit[hit >= 0][0]])
                detail = f"{capsule.link} hits the scene at {point}."
                return Rejection(reason=RejectionReason.SCENE, stage=stage, detail=detail)
        return None

    def _heights(self, T_base_pivots: np.ndarray, jaws: np.ndarray) -> np.ndarray:
        parts = ((T_base_pivots, self._shape.fixed), (T_base_pivots @ moving_jaw_pose(jaws), self._shape.moving_jaw))
        return np.min([self._lowest(T, vertices) for T, vertices in parts], axis=0)

    def _lowest(self, T: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        up = self.scene.table.normal
        # Heights alone are needed: one product for each vertex and pose instead of three
        return (up @ T[:, :3, :3] @ vertices.T).min(axis=1) + T[:, :3, 3] @ up - self.scene.table.offset_m

    def _hits(self, index: SceneIndex, parts: tuple, threshold_m: float, active: np.ndarray) -> np.ndarray:
        """Return a point (N, 3) that each pose hits with any of `parts`; NaN where none is, or where not `active`."""
        found = np.full((len(active), 3), np.nan)
        if threshold_m < 0.0 or not len(index):
            return found
        for T, vertices in parts:
            rows = np.flatnonzero(active & np.isnan(found[:, 0]))
            _, hit = index.first_hits(T[rows], vertices, threshold_m)
            found[rows[hit >= 0]] = index.points[hit[hit >= 0]]
        return found


def warm_up() -> None:
    """Load compiled kernels and meshes, so that the first plan is as fast as the next."""
    pose, point, read_only = np.eye(4)[None], np.zeros((1, 3)), gripper_shape().fixed[:1]
    index = SceneIndex(point)
    index.near(point, 0.0)
    for vertices in (point, read_only):  # compiled apart
        index.first_hits(pose, vertices, 0.0)
    self_collision.warm_up()


def _reject_height(height_m: float, allowed_m: float, stage: PlanningStage) -> Rejection:
    detail = (
        f"the gripper's lowest point would be {height_m * 1e3:.0f} mm above the table; "
        f"allowed is {allowed_m * 1e3:.0f} mm."
    )
    return Rejection(reason=RejectionReason.TABLE, stage=stage, detail=detail)


def _format_point(point: np.ndarray) -> str:
    x, y, z = point
    return f"({x:.3f}, {y:.3f}, {z:.3f}) m"


def _capsule_surface(start: np.ndarray, end: np.ndarray, radius_m: float) -> np.ndarray:
    """Return points about 12 mm apart on a capsule's round side."""
    # The bound keeps a capsule of no length, a sphere, finite
    axis = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    # The coordinate axis least parallel to the capsule: the product cannot vanish
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    along = np.linspace(0.0, 1.0, int(np.linalg.norm(end - start) / _SURFACE_SPACING_M) + 2)[:, None, None]
    n_around = int(2.0 * np.pi * radius_m / _SURFACE_SPACING_M)
    turn = np.linspace(0.0, 2.0 * np.pi, n_around, endpoint=False)[None, :, None]
    ring = np.cos(turn) * across + np.sin(turn) * np.cross(axis, across)
    return (start + along * (end - start) + radius_m * ring).reshape(-1, 3)


_LINK_SURFACES = [_capsule_surface(np.array(c.start), np.array(c.end), c.radius_m) for c in CAPSULES]
