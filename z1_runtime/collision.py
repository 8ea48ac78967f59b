"""Says whether gripper poses and whole trajectories hit the table, the arm itself, the scene or the object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from hal import z1
from z1_runtime.gripper import mover_pose
from z1_runtime.kinematics import Kinematics
from z1_runtime.robot_model import CAPSULES, GRIPPER_OBSTACLES, SELF_PAIRS, GripperShape, gripper_shape
from z1_runtime.types import JointTrajectory, Observation, Plane
from z1_runtime.voxels import SceneIndex

_TABLE_LINKS = ("link02", "link03", "link04", "link05")
_OBSTACLES = np.array([c.link in GRIPPER_OBSTACLES for c in CAPSULES])
_OVER_TABLE = np.array([c.link in _TABLE_LINKS for c in CAPSULES])
_RADII = np.array([c.radius_m for c in CAPSULES])
_PAIRS = np.array(
    [
        (i, j)
        for link, others in SELF_PAIRS
        for i, one in enumerate(CAPSULES)
        for j, other in enumerate(CAPSULES)
        if one.link == link and other.link in others
    ]
)
_RIM_M, _DROP_STEP_M = 0.010, 0.002
_SELF_VERTICES = 400  # heads of the gripper's points that are tried against the capsules, which have 10 mm to spare


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """What is hit first."""

    reason: str
    """`table`, `scene`, `self` or `object`."""
    detail: str
    """A sentence with the figures."""


@dataclass(frozen=True, slots=True, eq=False)
class GripperHits:
    """What each of N gripper poses hits."""

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
        q_frame: np.ndarray,
        config: CollisionConfig | None = None,
    ) -> None:
        """Index what `observation` saw; `q_frame` (7,) is where the arm was then [rad]."""
        self.config = config or CollisionConfig()
        self._kinematics = kinematics
        self._shape: GripperShape = gripper_shape()
        T_base_camera = observation.T_base_camera
        self.table = plane_in_base(observation.table, T_base_camera)
        self.object_points = _moved(T_base_camera, observation.object_points)
        self.object_index = SceneIndex(self._down_to_table(self.object_points))
        scene = _moved(T_base_camera, observation.scene_points)
        scene = scene[self.table.height_m(scene) > self.config.table_noise_m]
        scene = scene[~self.object_index.near(scene, self.config.object_halo_m)]
        own = SceneIndex(self._gripper_points(q_frame))
        self.scene_index = SceneIndex(scene[~own.near(scene, self.config.robot_halo_m)])

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
        T_base_movers = T_base_pivots @ mover_pose(jaws)
        parts = ((T_base_pivots, self._shape.fixed), (T_base_movers, self._shape.mover))
        height = np.min([self._lowest(T, vertices) for T, vertices in parts], axis=0)
        scene = self._hits(self.scene_index, parts, scene_m)
        hit_object = self._hits(self.object_index, parts, object_m)
        return GripperHits(height, scene, hit_object, config.table_margin_m)

    def check_posture(self, q: np.ndarray) -> Problem | None:
        """Return what the arm at `q` (7,) hits: table or itself."""
        return self._first_arm_problem(*self._poses(q[None]))

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
        links, pivots = self._poses(q)
        problem = self._first_arm_problem(links, pivots)
        if problem is not None:
            return problem
        hits = self.check_grippers(
            pivots, q[:, -1], scene_threshold_m=threshold_m, object_threshold_m=object_threshold_m
        )
        blocked = ~hits.free()
        if blocked.any():
            return hits.problem(int(blocked.argmax()))
        return self._first_link_hit(links)

    def _poses(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return T_base_link (N, C, 4, 4) of every capsule's link and T_base_pivot (N, 4, 4) at joints (N, 7)."""
        links = np.empty((len(q), len(CAPSULES), 4, 4))
        pivots = np.empty((len(q), 4, 4))
        for n, joints in enumerate(q):
            poses = self._kinematics.link_poses(joints)
            for c, capsule in enumerate(CAPSULES):
                links[n, c] = poses[capsule.link]
            pivots[n] = poses["link06"] @ z1.T_FLANGE_PIVOT
        return links, pivots

    def _first_arm_problem(self, links: np.ndarray, pivots: np.ndarray) -> Problem | None:
        ends = np.einsum("ncij,cej->ncei", links[..., :3, :3], _ENDS) + links[:, :, None, :3, 3]  # (N, C, 2, 3)
        heights = (ends @ self.table.normal - self.table.offset_m).min(axis=2) - _RADII
        heights[:, ~_OVER_TABLE] = np.inf
        if (heights < self.config.link_margin_m).any():
            n, c = np.unravel_index(heights.argmin(), heights.shape)
            return Problem(
                reason="table",
                detail=f"{CAPSULES[c].link} would be {heights[n, c] * 1e3:.0f} mm above the table; "
                f"allowed is {self.config.link_margin_m * 1e3:.0f} mm.",
            )
        one, other = _first_capsule_pair(ends, _RADII, _PAIRS)
        if one >= 0:
            return Problem(reason="self", detail=f"{CAPSULES[one].link} would hit {CAPSULES[other].link}.")
        vertices = self._shape.fixed[:_SELF_VERTICES]
        c = _first_capsule_hit(pivots, vertices, np.ascontiguousarray(ends[:, _OBSTACLES]), _RADII[_OBSTACLES])
        if c >= 0:
            link = [capsule.link for capsule in CAPSULES if capsule.link in GRIPPER_OBSTACLES][c]
            return Problem(reason="self", detail=f"gripper or camera would hit {link}.")
        return None

    def _first_link_hit(self, links: np.ndarray) -> Problem | None:
        for c, capsule in enumerate(CAPSULES):
            if not _OVER_TABLE[c]:
                continue
            _, hit = self.scene_index.first_hits(links[:, c], _LINK_SURFACES[c], self.config.transfer_threshold_m)
            if (hit >= 0).any():
                point = self.scene_index.points[hit[hit >= 0][0]]
                return Problem(reason="scene", detail=f"{capsule.link} hits the scene at {_metres(point)}.")
        return None

    def _lowest(self, T: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        up = self.table.normal
        return (up @ T[:, :3, :3] @ vertices.T).min(axis=1) + T[:, :3, 3] @ up - self.table.offset_m

    def _hits(self, index: SceneIndex, parts: tuple, threshold_m: float) -> np.ndarray:
        found = np.full((len(parts[0][0]), 3), np.nan)
        if threshold_m < 0.0 or not len(index):
            return found
        for T, vertices in parts:
            _, hit = index.first_hits(T, vertices, threshold_m)
            found[hit >= 0] = index.points[hit[hit >= 0]]
        return found

    def _gripper_points(self, q: np.ndarray) -> np.ndarray:
        T_base_pivot = self._kinematics.pivot(q[: z1.N_ARM])
        T_base_mover = T_base_pivot @ mover_pose(float(q[-1]))
        return np.concatenate([_moved(T_base_pivot, self._shape.fixed), _moved(T_base_mover, self._shape.mover)])


def warm_up() -> None:
    """Load what is compiled and what is read from meshes, so that the first plan is as fast as the next."""
    pose, point, read_only = np.eye(4)[None], np.zeros((1, 3)), gripper_shape().fixed[:1]
    index = SceneIndex(point)
    index.near(point, 0.0)
    for vertices in (point, read_only):  # compiled apart
        index.first_hits(pose, vertices, 0.0)
    ends = np.zeros((1, 1, 2, 3))
    _first_capsule_hit(pose, read_only, ends, np.zeros(1))
    _first_capsule_pair(ends, np.zeros(1), np.zeros((1, 2), dtype=np.int64))


def plane_in_base(plane: Plane, T_base_camera: np.ndarray) -> Plane:
    """Return a camera-frame plane in the base frame."""
    normal = T_base_camera[:3, :3] @ plane.normal
    return Plane(normal=normal, offset_m=float(plane.offset_m + normal @ T_base_camera[:3, 3]))


def _moved(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


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


_ENDS = np.array([[c.start, c.end] for c in CAPSULES])
_LINK_SURFACES = [_capsule_surface(np.array(c.start), np.array(c.end), c.radius_m) for c in CAPSULES]


@njit(cache=True, nogil=True)
def _squared_distance(p, a, b):
    """Return the squared distance of point `p` from segment `a` `b`."""
    along = 0.0
    length = 0.0
    for i in range(3):
        along += (p[i] - a[i]) * (b[i] - a[i])
        length += (b[i] - a[i]) ** 2
    t = 0.0 if length <= 0.0 else min(max(along / length, 0.0), 1.0)
    total = 0.0
    for i in range(3):
        total += (p[i] - a[i] - t * (b[i] - a[i])) ** 2
    return total


@njit(cache=True, nogil=True)
def _first_capsule_hit(T, vertices, ends, radii):
    """Return the first capsule (index) that any of `vertices`, moved by `T[n]`, is inside of at pose n, or −1."""
    p = np.empty(3)
    for n in range(T.shape[0]):
        for v in range(vertices.shape[0]):
            for i in range(3):
                p[i] = T[n, i, 3]
                for j in range(3):
                    p[i] += T[n, i, j] * vertices[v, j]
            for c in range(radii.shape[0]):
                if _squared_distance(p, ends[n, c, 0], ends[n, c, 1]) < radii[c] ** 2:
                    return c
    return -1


@njit(cache=True, nogil=True)
def _first_capsule_pair(ends, radii, pairs):
    """Return the first two capsules of `pairs` that overlap at any pose, or (−1, −1).

    The shorter way to two segments' distance: one is walked in 6 mm steps, which its radius covers.
    """
    p = np.empty(3)
    for n in range(ends.shape[0]):
        for k in range(pairs.shape[0]):
            one, other = pairs[k, 0], pairs[k, 1]
            a, b = ends[n, one, 0], ends[n, one, 1]
            steps = int(np.sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2) / 0.006) + 1
            for s in range(steps + 1):
                for i in range(3):
                    p[i] = a[i] + (b[i] - a[i]) * s / steps
                reach = radii[one] + radii[other]
                if _squared_distance(p, ends[n, other, 0], ends[n, other, 1]) < reach**2:
                    return one, other
    return -1, -1
