"""Says whether gripper poses and whole trajectories hit the table, the scene or the object that one frame saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.transforms import transform_points
from hal.base.z1_gripper import moving_jaw_pose
from hal.base.z1_shape import CAPSULES
from z1_runtime.collision import self_collision
from z1_runtime.collision.self_collision import MAY_MEET_SCENE, ArmPoses, Problem, first_arm_problem
from z1_runtime.collision.voxel_grid import MAX_THRESHOLD_M, SceneIndex
from z1_runtime.geometry.gripper_mesh import gripper_shape
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.types import JointTrajectory, Observation, Plane

_RIM_M, _DROP_STEP_M = 0.010, 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionConfig:
    """How near is a collision."""

    scene_threshold_m: float = 0.002
    """A scene point nearer than this to the gripper's surface is hit (the paper's 2 mm) [m]."""
    object_threshold_m: float = 0.0035
    """The same for the object's own points while the opened jaws go around it; perception trims about 1 mm off its
    edges and the arm tracks within 2 mm [m]."""
    transfer_threshold_m: float = 0.005
    """The same for scene and object while the arm goes to the pre-grasp [m]."""
    table_margin_m: float = 0.004
    """Least height of the gripper over the table [m]."""
    closing_margin_m: float = 0.002
    """The same while the jaws close and the hand turns with them: what the plane may be off, as the HAL's guard refuses
    what goes below its own [m]."""
    link_margin_m: float = 0.010
    """Least height of the arm's links over the table [m]."""
    table_noise_m: float = 0.007
    """Scene points lower than this over the table are its own noise; the plane stands for them [m]."""
    object_halo_m: float = 0.006
    """Scene points nearer than this to the object are its own border [m]."""
    robot_halo_m: float = 0.010
    """Scene points nearer than this to gripper and camera, as they were when the frame was taken, are those [m]."""
    cut_off_m: float = 0.015
    """An object whose lowest seen points are higher than this over the table goes on below them [m]."""
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


@dataclass(frozen=True, slots=True, eq=False)
class GripperHits:
    """What each of N gripper poses hits: the first of table, scene and object; what comes after that is not asked."""

    height_m: np.ndarray
    """(N,) lowest point over the table [m]."""
    scene: np.ndarray
    """(N, 3) a scene point that is hit, NaN where none is [m]."""
    object: np.ndarray
    """(N, 3) a point of the object that is hit, NaN where none is [m]."""
    table_margin_m: float
    """Least height allowed [m]."""

    def free(self) -> np.ndarray:
        """Return (N,) whether a pose hits nothing."""
        return (self.height_m >= self.table_margin_m) & np.isnan(self.scene[:, 0]) & np.isnan(self.object[:, 0])

    def problem(self, n: int) -> Problem | None:
        """Return what pose `n` hits first, or None."""
        if self.height_m[n] < self.table_margin_m:
            return Problem(
                reason="table",
                detail=f"the gripper's lowest point would be {self.height_m[n] * 1e3:.0f} mm above the table; "
                f"allowed is {self.table_margin_m * 1e3:.0f} mm.",
            )
        for reason, point in (("scene", self.scene[n]), ("object", self.object[n])):
            if not np.isnan(point[0]):
                return Problem(reason=reason, detail=f"the gripper hits the {reason} at {_metres(point)}.")
        return None


class CollisionChecker:
    """The surroundings of one frame, indexed, in the base frame."""

    def __init__(
        self,
        kinematics: Kinematics,
        observation: Observation,
        q_frame: np.ndarray | None,
        config: CollisionConfig | None = None,
    ) -> None:
        """Index what `observation` saw; `q_frame` (7,) is where the arm was then, if known [rad].

        Perception takes the robot's own gripper off the scene; with `q_frame` what is left of it goes too.
        """
        self.config = config or CollisionConfig()
        self._kinematics = kinematics
        self._shape = gripper_shape()
        T_base_camera = observation.T_base_camera
        self.table = plane_in_base(observation.table, T_base_camera)
        self.object_points = transform_points(T_base_camera, observation.object_points)
        self.occluded_points = transform_points(T_base_camera, observation.occluded_points)
        whole = np.concatenate([self._down_to_table(self.object_points), self.occluded_points])
        self.object_index = SceneIndex(whole)
        scene = transform_points(T_base_camera, observation.scene_points)
        scene = scene[self.table.height_m(scene) > self.config.table_noise_m]
        scene = scene[~self.object_index.near(scene, self.config.object_halo_m)]
        if q_frame is not None:
            own = SceneIndex(self._gripper_points(q_frame))
            scene = scene[~own.near(scene, self.config.robot_halo_m)]
        self.scene_index = SceneIndex(scene)

    def _down_to_table(self, points: np.ndarray) -> np.ndarray:
        """Return the object's points and, where the picture cut it off above the table, what must be below them.

        Near the arm the camera sees the upper part only; jaws sent in below it would push what was not seen.
        """
        if not len(points):
            return points
        height = self.table.height_m(points)
        lowest = float(np.percentile(height, 1.0))
        if lowest < self.config.cut_off_m:
            return points
        rim = points[height < lowest + _RIM_M]
        drops = np.arange(0.0, lowest, _DROP_STEP_M)[:, None, None]
        return np.concatenate([points, (rim - drops * self.table.normal).reshape(-1, 3)])

    def check_grippers(
        self,
        T_base_pivots: np.ndarray,
        jaws: np.ndarray,
        *,
        scene_threshold_m: float | None = None,
        object_threshold_m: float | None = None,
    ) -> GripperHits:
        """Test gripper, camera and bracket at pivot poses (N, 4, 4) and mover angles (N,) [rad].

        Args:
            T_base_pivots: (N, 4, 4).
            jaws: (N,).
            scene_threshold_m: the configured one if None [m].
            object_threshold_m: the configured one if None; negative leaves the object out [m].
        """
        config = self.config
        scene_m = config.scene_threshold_m if scene_threshold_m is None else scene_threshold_m
        object_m = config.object_threshold_m if object_threshold_m is None else object_threshold_m
        T_base_movers = T_base_pivots @ moving_jaw_pose(jaws)
        parts = ((T_base_pivots, self._shape.fixed), (T_base_movers, self._shape.mover))
        height = np.min([self._lowest(T, vertices) for T, vertices in parts], axis=0)
        clear = height >= config.table_margin_m
        scene = self._hits(self.scene_index, parts, scene_m, clear)
        hit_object = self._hits(self.object_index, parts, object_m, clear & np.isnan(scene[:, 0]))
        return GripperHits(height, scene, hit_object, config.table_margin_m)

    def spare_height_m(self, T_base_pivots: np.ndarray, jaws: np.ndarray) -> np.ndarray:
        """Return how far (N,) the gripper could still go down at pivot poses (N, 4, 4) and mover angles (N,) [m]."""
        return self._heights(T_base_pivots, jaws) - self.config.table_margin_m

    def check_posture(self, q: np.ndarray) -> Problem | None:
        """Return what the arm at `q` (7,) hits: table or itself."""
        return first_arm_problem(ArmPoses.at(self._kinematics, q[None]), self.table, self.config.link_margin_m)

    def check_trajectory(
        self, trajectory: JointTrajectory, *, threshold_m: float, object_threshold_m: float = -1.0
    ) -> Problem | None:
        """Return the first thing hit along `trajectory`, or None.

        Args:
            trajectory: what the arm is to do; sampled every `sample_s`, its end included.
            threshold_m: distance from a scene point that is a hit [m].
            object_threshold_m: the same for the object; negative leaves it out, as when it is held [m].
        """
        step = max(1, round(self.config.sample_s / z1.CONTROL_PERIOD_S))
        q = np.concatenate([trajectory.q[:-1:step], trajectory.q[-1:]])
        poses = ArmPoses.at(self._kinematics, q)
        problem = first_arm_problem(poses, self.table, self.config.link_margin_m)
        if problem is not None:
            return problem
        hits = self.check_grippers(
            poses.pivots, q[:, -1], scene_threshold_m=threshold_m, object_threshold_m=object_threshold_m
        )
        blocked = ~hits.free()
        if blocked.any():
            return hits.problem(int(blocked.argmax()))
        return self._first_link_hit(poses.links)

    def check_closing(self, trajectory: JointTrajectory) -> Problem | None:
        """Return how the gripper comes too near to the table along `trajectory`, or None; all else it may touch."""
        step = max(1, round(self.config.sample_s / z1.CONTROL_PERIOD_S))
        q = np.concatenate([trajectory.q[:-1:step], trajectory.q[-1:]])
        lowest = float(self._heights(ArmPoses.at(self._kinematics, q).pivots, q[:, -1]).min())
        if lowest >= self.config.closing_margin_m:
            return None
        return Problem(
            reason="table",
            detail=f"the gripper's lowest point would be {lowest * 1e3:.0f} mm above the table; allowed is "
            f"{self.config.closing_margin_m * 1e3:.0f} mm.",
        )

    def _first_link_hit(self, links: np.ndarray) -> Problem | None:
        for c, capsule in enumerate(CAPSULES):
            if not MAY_MEET_SCENE[c]:
                continue
            _, hit = self.scene_index.first_hits(links[:, c], _LINK_SURFACES[c], self.config.transfer_threshold_m)
            if (hit >= 0).any():
                point = self.scene_index.points[hit[hit >= 0][0]]
                return Problem(reason="scene", detail=f"{capsule.link} hits the scene at {_metres(point)}.")
        return None

    def _heights(self, T_base_pivots: np.ndarray, jaws: np.ndarray) -> np.ndarray:
        parts = ((T_base_pivots, self._shape.fixed), (T_base_pivots @ moving_jaw_pose(jaws), self._shape.mover))
        return np.min([self._lowest(T, vertices) for T, vertices in parts], axis=0)

    def _lowest(self, T: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        up = self.table.normal
        return (up @ T[:, :3, :3] @ vertices.T).min(axis=1) + T[:, :3, 3] @ up - self.table.offset_m

    def _hits(self, index: SceneIndex, parts: tuple, threshold_m: float, asked: np.ndarray) -> np.ndarray:
        """Return a point (N, 3) that each pose hits with any of `parts`; NaN where none is, or where not `asked`."""
        found = np.full((len(asked), 3), np.nan)
        if threshold_m < 0.0 or not len(index):
            return found
        for T, vertices in parts:
            rows = np.flatnonzero(asked & np.isnan(found[:, 0]))
            _, hit = index.first_hits(T[rows], vertices, threshold_m)
            found[rows[hit >= 0]] = index.points[hit[hit >= 0]]
        return found

    def _gripper_points(self, q: np.ndarray) -> np.ndarray:
        T_base_pivot = self._kinematics.pivot(q[: z1.N_ARM])
        T_base_mover = T_base_pivot @ moving_jaw_pose(float(q[-1]))
        return np.concatenate(
            [transform_points(T_base_pivot, self._shape.fixed), transform_points(T_base_mover, self._shape.mover)]
        )


def warm_up() -> None:
    """Load what is compiled and what is read from meshes, so that the first plan is as fast as the next."""
    pose, point, read_only = np.eye(4)[None], np.zeros((1, 3)), gripper_shape().fixed[:1]
    index = SceneIndex(point)
    index.near(point, 0.0)
    for vertices in (point, read_only):  # compiled apart
        index.first_hits(pose, vertices, 0.0)
    self_collision.warm_up()


def plane_in_base(plane: Plane, T_base_camera: np.ndarray) -> Plane:
    """Return a camera-frame plane in the base frame."""
    normal = T_base_camera[:3, :3] @ plane.normal
    return Plane(normal=normal, offset_m=float(plane.offset_m + normal @ T_base_camera[:3, 3]))


def _metres(point: np.ndarray) -> str:
    x, y, z = point
    return f"({x:.3f}, {y:.3f}, {z:.3f}) m"


def _capsule_surface(start: np.ndarray, end: np.ndarray, radius_m: float) -> np.ndarray:
    """Return points about 12 mm apart on a capsule's round side."""
    axis = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    aside = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    aside /= np.linalg.norm(aside)
    along = np.linspace(0.0, 1.0, int(np.linalg.norm(end - start) / 0.012) + 2)[:, None, None]
    turn = np.linspace(0.0, 2.0 * np.pi, int(2.0 * np.pi * radius_m / 0.012), endpoint=False)[None, :, None]
    ring = np.cos(turn) * aside + np.sin(turn) * np.cross(axis, aside)
    return (start + along * (end - start) + radius_m * ring).reshape(-1, 3)


_LINK_SURFACES = [_capsule_surface(np.array(c.start), np.array(c.end), c.radius_m) for c in CAPSULES]
