"""The surroundings of one pick in the base frame: built once, shared by ranking, planning and visualization."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.transforms import transform_points
from hal.base.z1 import moving_jaw_pose
from z1_runtime.collision.voxel_grid import MAX_THRESHOLD_M, SceneIndex
from z1_runtime.geometry.gripper_geometry import gripper_shape
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.types import Observation, Plane


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionConfig:
    """Distances below which two things count as colliding."""

    scene_threshold_m: float = 0.002
    """Minimum distance of scene points from the gripper's surface, the paper's 2 mm [m]."""
    object_threshold_m: float = 0.0035
    """The same for the object's own points while the opened jaws go around it; perception trims about 1 mm off its
    edges and the arm tracks within 2 mm [m]."""
    transfer_threshold_m: float = 0.005
    """The same for scene and object during the transfer to the pre-grasp [m]."""
    table_margin_m: float = 0.004
    """Minimum height of the gripper over the table [m]."""
    closing_margin_m: float = 0.002
    """The same while the jaws close and the gripper turns with them: the plane's uncertainty, as the HAL's guard
    rejects what goes below its own [m]."""
    link_margin_m: float = 0.010
    """Minimum height of the arm's links over the table [m]."""
    table_noise_m: float = 0.007
    """Scene points lower than this over the table are its noise; the plane represents them [m]."""
    object_halo_m: float = 0.006
    """Scene points nearer than this to the object are its own border [m]."""
    robot_halo_m: float = 0.010
    """Scene points nearer than this to gripper and camera, as posed in the frame, are the robot's own [m]."""
    cut_off_m: float = 0.015
    """An object whose lowest observed points are higher than this over the table continues down to it [m]."""
    sample_s: float = 0.016
    """Time between two checked samples of a trajectory [s]."""

    def __post_init__(self) -> None:
        thresholds = ("scene_threshold_m", "object_threshold_m", "transfer_threshold_m")
        for name in (*thresholds, "object_halo_m", "robot_halo_m"):
            if not 0.0 <= getattr(self, name) <= MAX_THRESHOLD_M:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; allowed is 0 to {MAX_THRESHOLD_M} m.")
        for name in ("table_margin_m", "closing_margin_m", "link_margin_m", "table_noise_m", "cut_off_m"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be finite and not negative.")
        if not z1.CONTROL_PERIOD_S <= self.sample_s <= 0.05:
            raise InvalidValueError(f"sample_s is {self.sample_s}; allowed is {z1.CONTROL_PERIOD_S} to 0.05 s.")


_RIM_M = 0.010  # height of the band of lowest points that is continued down to the table
_DROP_STEP_M = 0.002  # as dense as perception leaves the object itself


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlanningScene:
    """Table, object and obstacles of one observation, in the base frame and indexed for distance queries."""

    observation: Observation
    """The frame's clouds, in the camera frame."""
    config: CollisionConfig
    table: Plane
    object_points: np.ndarray
    """(N, 3) observed points of the object [m]."""
    occluded_points: np.ndarray
    """(K, 3) where the object may continue behind an occlusion [m]."""
    object_index: SceneIndex
    """The object, its continuation down to the table, and its occluded points."""
    scene_index: SceneIndex
    """All other points, without the table's noise, the object's border and the robot's halo."""

    @classmethod
    def from_observation(
        cls,
        observation: Observation,
        q: np.ndarray | None,
        kinematics: Kinematics,
        config: CollisionConfig | None = None,
    ) -> PlanningScene:
        """Index the clouds of `observation` in the base frame.

        Args:
            observation: one frame's clouds.
            q: (7,) joints at which the frame was taken [rad]; perception masks the gripper, and points left within
                `robot_halo_m` of it are removed here. None keeps them.
            kinematics: of the arm.
            config: distances; the defaults if None.

        Raises:
            ValueError: a point is not finite.
        """
        config = config or CollisionConfig()
        T_base_camera = observation.T_base_camera
        table = plane_in_base(observation.table, T_base_camera)
        object_points = transform_points(T_base_camera, observation.object_points)
        occluded_points = transform_points(T_base_camera, observation.occluded_points)
        object_index = SceneIndex(
            np.concatenate([_extend_to_table(object_points, table, config.cut_off_m), occluded_points])
        )
        scene = transform_points(T_base_camera, observation.scene_points)
        scene = scene[table.height_m(scene) > config.table_noise_m]
        scene = scene[~object_index.near(scene, config.object_halo_m)]
        if q is not None:
            scene = scene[~SceneIndex(_gripper_points(kinematics, q)).near(scene, config.robot_halo_m)]
        return cls(
            observation=observation,
            config=config,
            table=table,
            object_points=object_points,
            occluded_points=occluded_points,
            object_index=object_index,
            scene_index=SceneIndex(scene),
        )

    @property
    def T_base_camera(self) -> np.ndarray:
        """(4, 4) camera pose when the frame was taken."""
        return self.observation.T_base_camera


def plane_in_base(plane: Plane, T_base_camera: np.ndarray) -> Plane:
    """Return a camera-frame plane in the base frame."""
    normal = T_base_camera[:3, :3] @ plane.normal
    return Plane(normal=normal, offset_m=float(plane.offset_m + normal @ T_base_camera[:3, 3]))


def _extend_to_table(points: np.ndarray, table: Plane, cut_off_m: float) -> np.ndarray:
    """Return the object's points and, where the picture's edge cut it off above the table, its continuation below.

    Near the arm the camera observes the upper part only; jaws sent in below it would push the unobserved rest.
    """
    if not len(points):
        return points
    height = table.height_m(points)
    # A percentile, not the minimum: one speckle near the table would count as the object's foot
    lowest = float(np.percentile(height, 1.0))
    if not lowest >= cut_off_m:  # NaN is left to the index, which rejects it
        return points
    rim = points[height < lowest + _RIM_M]
    drops = np.arange(0.0, lowest, _DROP_STEP_M)[:, None, None]
    return np.concatenate([points, (rim - drops * table.normal).reshape(-1, 3)])


def _gripper_points(kinematics: Kinematics, q: np.ndarray) -> np.ndarray:
    """Return points (V, 3) on gripper, bracket and camera at joints `q` (7,)."""
    shape = gripper_shape()
    T_base_pivot = kinematics.pivot(q[: z1.N_ARM])
    T_base_jaw = T_base_pivot @ moving_jaw_pose(float(q[-1]))
    return np.concatenate([transform_points(T_base_pivot, shape.fixed), transform_points(T_base_jaw, shape.moving_jaw)])
