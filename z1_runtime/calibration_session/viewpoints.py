"""Viewpoints of a calibration board: well spread, in view, free of collisions; and the motions between them.

A hand-eye calibration needs rotations about many axes, so views are sampled all around the board and chosen one by
one, each as far as possible from those before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hal.base import z1
from hal.base.errors import InvalidValueError, Z1Error
from hal.base.messages import Intrinsics, RgbdFrame
from hal.base.transforms import inverse, make_pose, transform_points
from models.types import Detection
from z1_runtime.collision.planning_scene import CollisionConfig, PlanningScene
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.motion.trajectory import MotionLimits, joint_path
from z1_runtime.perception.point_cloud import back_project, continuous_pixels, valid_pixels
from z1_runtime.perception.self_filter import SelfFilter
from z1_runtime.perception.table_plane import TableConfig, expected_table, fit_table
from z1_runtime.types import JointTrajectory, Observation

_MAX_RANGE_M = 0.8
_OBSTACLE_M = 0.015  # minimum height above the table of a point that counts as an obstacle
_METRES_PER_RAD = 0.35  # 0.35 m of camera travel count as much as 1 rad of rotation


class NoViewpointsError(Z1Error, RuntimeError):
    """Too few views of the board are reachable and free of collisions."""

    default_code = "no_viewpoints"


CONSERVATIVE_CLEARANCE = CollisionConfig(transfer_threshold_m=0.010, table_margin_m=0.020, link_margin_m=0.020)
"""Clearances for extrinsics that are not calibrated yet."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewpointConfig:
    """Constraints on the views."""

    n: int = 20
    """Number of views."""
    distance_m: tuple[float, float] = (0.17, 0.38)
    """From the camera to the board along the optical axis [m]; the D405 is sharp from 0.07 to 0.5 m."""
    max_tilt_deg: float = 50.0
    """Largest angle between the optical axis and the board's normal [°]."""
    min_visible_ratio: float = 0.6
    """Minimum ratio of the board's corners in the image and not occluded by the gripper."""
    border_px: float = 12.0
    """Corners closer than this to the image border do not count, since the extrinsics are not calibrated yet [px]."""
    n_drawn: int = 1500
    """Number of sampled views, from which the best are chosen."""
    jaw: float = z1.GRIPPER_CLOSED
    """Jaw angle during the capture [rad]; closed jaws occlude least."""

    def __post_init__(self) -> None:
        low, high = self.distance_m
        if not (1 <= self.n <= self.n_drawn and 0.07 <= low < high <= 0.6 and 0.0 < self.max_tilt_deg <= 70.0):
            raise InvalidValueError(
                f"views out of range (n {self.n}, distance_m {self.distance_m}, max_tilt_deg "
                f"{self.max_tilt_deg}; "
                f"allowed 1 to {self.n_drawn} views, 0.07 to 0.6 m, above 0 to 70°)."
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Viewpoint:
    """One view of the board."""

    q: np.ndarray
    """(7,) joint positions [rad]."""
    T_base_camera: np.ndarray
    """(4, 4) camera pose by the assumed extrinsics."""
    visible_ratio: float
    """Expected ratio of visible corners."""


def scan_scene(
    kinematics: Kinematics,
    frame: RgbdFrame,
    q: np.ndarray,
    T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA,
    config: CollisionConfig | None = None,
) -> CollisionChecker:
    """Return a collision checker for the table and the obstacles on it in `frame`, taken at joints `q` (7,) [rad].

    Raises:
        NoTableError: the table is not in view.
    """
    T_base_camera = kinematics.flange(q[: z1.N_ARM]) @ T_flange_camera
    depth = SelfFilter().mask_gripper(frame, float(q[-1]), T_flange_camera).depth_m
    usable = valid_pixels(depth, _MAX_RANGE_M) & continuous_pixels(depth)
    points = back_project(depth, frame.intrinsics, usable)
    # Fitted, not assumed: wrong extrinsics tilt the table, and its far end would be an obstacle
    fit = fit_table(points, expected_table(T_base_camera), TableConfig())
    return _checker(
        kinematics, frame, T_base_camera, points[fit.above(points, _OBSTACLE_M)], q, config or CONSERVATIVE_CLEARANCE
    )


def make_table_checker(kinematics: Kinematics, frame: RgbdFrame, q: np.ndarray) -> CollisionChecker:
    """Return a checker for the table alone, without margins, for the motion home from joints `q` (7,) [rad]."""
    no_margins = CollisionConfig(table_margin_m=0.0, link_margin_m=0.0)
    return _checker(kinematics, frame, kinematics.flange(q[: z1.N_ARM]), np.empty((0, 3)), q, no_margins)


def _checker(  # noqa: PLR0917 - robot, frame, pose of the camera, then what follows from them
    kinematics: Kinematics,
    frame: RgbdFrame,
    T_base_camera: np.ndarray,
    obstacles: np.ndarray,
    q: np.ndarray,
    config: CollisionConfig,
) -> CollisionChecker:
    """Return a checker for the table and points (N, 3) in the camera frame [m]."""
    observation = Observation(
        frame=frame,
        T_base_camera=T_base_camera,
        detection=Detection(label="board", confidence=1.0, box_px=(0, 0, 0, 0)),
        object_points=np.empty((0, 3)),
        scene_points=obstacles,
        # z = 0 of the base: converted back by the same extrinsics, so their error cancels
        table=expected_table(T_base_camera),
    )
    return CollisionChecker(kinematics, PlanningScene.from_observation(observation, q, kinematics, config))


def find_viewpoints(
    kinematics: Kinematics,
    checker: CollisionChecker,
    intrinsics: Intrinsics,
    T_base_board: np.ndarray,
    corners_m: np.ndarray,
    *,
    q_start: np.ndarray,
    T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA,
    existing: Sequence[np.ndarray] = (),
    config: ViewpointConfig | None = None,
    seed: int = 0,
) -> list[Viewpoint]:
    """Return `config.n` views in the order of a short tour from `q_start` (7,) [rad].

    Args:
        kinematics: of the arm.
        checker: of collisions.
        intrinsics: of the camera.
        T_base_board: (4, 4) approximate pose of the board, z into it.
        corners_m: (N, 3) corners in the board frame [m].
        q_start: (7,) start of the tour [rad].
        T_flange_camera: (4, 4) assumed extrinsics.
        existing: camera poses (4, 4) of earlier views; the new ones keep a distance from them.
        config: constraints on the views.
        seed: of the sampling; the same arguments give the same views.

    Raises:
        NoViewpointsError: too few are reachable and free; the message counts the rejections.
    """
    config = config or ViewpointConfig()
    rng = np.random.default_rng(seed)
    occluded = SelfFilter().gripper_depth(intrinsics, config.jaw, T_flange_camera) > 0.0
    T_camera_pivot = inverse(T_flange_camera) @ z1.T_FLANGE_PIVOT
    rejected = dict.fromkeys(("out of view", "out of reach", "collision"), 0)
    found: list[Viewpoint] = []
    for T_base_camera in _sample_views(T_base_board, corners_m, config, rng):
        visible_ratio = _visible_ratio(
            intrinsics, occluded, inverse(T_base_camera) @ T_base_board, corners_m, config.border_px
        )
        if visible_ratio < config.min_visible_ratio:
            rejected["out of view"] += 1
            continue
        branches = kinematics.solve(T_base_camera @ T_camera_pivot)
        if not branches:
            rejected["out of reach"] += 1
            continue
        # The branch nearest to home, the paper's choice
        q = np.append(min(branches, key=lambda q: float(np.sum((q - z1.Q_HOME) ** 2))), config.jaw)
        if checker.check_posture(q) is not None or not _is_clear(checker, kinematics, q):
            rejected["collision"] += 1
            continue
        found.append(Viewpoint(q=q, T_base_camera=T_base_camera, visible_ratio=visible_ratio))
    if len(found) < config.n:
        reasons = ", ".join(f"{count} {reason}" for reason, count in rejected.items())
        raise NoViewpointsError(
            f"viewpoints: only {len(found)} of {config.n_drawn} sampled views are feasible, {config.n} are needed "
            f"({reasons}). "
            "Place the board flat, 0.35 to 0.5 m in front of the arm, clear the table around it, or "
            "reduce the number of poses."
        )
    return _sort_tour(_select_spread(found, config.n, existing), q_start)


def plan_free_motion(
    checker: CollisionChecker, q_from: np.ndarray, q_to: np.ndarray, limits: MotionLimits
) -> JointTrajectory | None:
    """Return a collision-free motion between joints (7,) [rad], direct or via home; None when both are blocked."""
    near_m = checker.config.transfer_threshold_m
    for via in ([], [np.append(z1.Q_HOME, q_to[-1])]):
        motion = joint_path(np.array([q_from, *via, q_to]), limits)
        if checker.check_trajectory(motion, threshold_m=near_m) is None:
            return motion
    return None


def _sample_views(
    T_base_board: np.ndarray, corners_m: np.ndarray, config: ViewpointConfig, rng: np.random.Generator
) -> list[np.ndarray]:
    """Return camera poses (4, 4) in base aimed at random points of the board, with random directions and rolls."""
    middle, half = corners_m.mean(axis=0), np.ptp(corners_m, axis=0) / 2
    views = []
    for _ in range(config.n_drawn):
        aim = middle + half * [*rng.uniform(-0.6, 0.6, 2), 0.0]
        # Uniform over the angle and not over the sphere, on which most views would be at large tilts
        tilt, azimuth, roll = rng.uniform(0, np.deg2rad(config.max_tilt_deg)), *rng.uniform(-np.pi, np.pi, 2)
        rotation = Rotation.from_rotvec(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
        R = (rotation * Rotation.from_euler("z", roll)).as_matrix()
        views.append(T_base_board @ make_pose(R, aim - rng.uniform(*config.distance_m) * R[:, 2]))
    return views


def _visible_ratio(
    i: Intrinsics, occluded: np.ndarray, T_camera_board: np.ndarray, corners_m: np.ndarray, border_px: float
) -> float:
    """Return the ratio of corners inside the image's border and not `occluded` (H, W) bool by the gripper."""
    points = transform_points(T_camera_board, corners_m)
    if (points[:, 2] <= 0.0).any():
        return 0.0
    u = i.fx * points[:, 0] / points[:, 2] + i.cx
    v = i.fy * points[:, 1] / points[:, 2] + i.cy
    inside = (u >= border_px) & (u < i.width - border_px) & (v >= border_px) & (v < i.height - border_px)
    inside[inside] = ~occluded[v[inside].astype(int), u[inside].astype(int)]
    return float(inside.mean())


def _is_clear(checker: CollisionChecker, kinematics: Kinematics, q: np.ndarray) -> bool:
    pivot = kinematics.pivot(q[: z1.N_ARM])[None]
    hits = checker.check_grippers(pivot, q[-1:], scene_threshold_m=checker.config.transfer_threshold_m)
    return bool(hits.free()[0])


def _select_spread(views: Sequence[Viewpoint], n: int, existing: Sequence[np.ndarray]) -> list[Viewpoint]:
    """Return `n` of `views` by farthest-point sampling from `existing`, or else from the one with most corners."""
    Ts = np.array([view.T_base_camera for view in views])
    nearest = np.full(len(views), np.inf)
    for T in existing:
        nearest = np.minimum(nearest, _distances(Ts, T))
    first = int(np.argmax([view.visible_ratio for view in views]))
    chosen: list[int] = []
    while len(chosen) < n:
        # Without an earlier view all distances are infinite
        chosen.append(int(nearest.argmax()) if np.isfinite(nearest).all() else first)
        nearest = np.minimum(nearest, _distances(Ts, Ts[chosen[-1]]))
    return [views[index] for index in chosen]


def _distances(Ts: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return the distances (N,) [rad] of views (N, 4, 4) from `T`, with travel converted to rotation."""
    angles = (Rotation.from_matrix(T[:3, :3]).inv() * Rotation.from_matrix(Ts[:, :3, :3])).magnitude()
    return np.hypot(angles, np.linalg.norm(Ts[:, :3, 3] - T[:3, 3], axis=1) / _METRES_PER_RAD)


def _sort_tour(views: list[Viewpoint], q_start: np.ndarray) -> list[Viewpoint]:
    """Return `views` ordered so that each is the nearest in joints to the one before."""
    left, tour, q = list(views), [], q_start
    while left:
        nearest = min(left, key=lambda view, q=q: float(np.abs(view.q - q).max()))
        left.remove(nearest)
        tour.append(nearest)
        q = nearest.q
    return tour
