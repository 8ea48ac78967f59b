"""Where to look at a calibration board from: well spread, in view, free of collisions, and the ways between.

A hand-eye calibration lives on turns about many axes, so views are drawn all around the board and chosen one by one,
each as far as possible from those before it.
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
from z1_runtime.collision.collision_config import CollisionConfig
from z1_runtime.collision.planning_scene import PlanningScene
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.motion.trajectory import MotionLimits, joint_path
from z1_runtime.perception.point_cloud import back_project, continuous_pixels, valid_pixels
from z1_runtime.perception.self_filter import SelfFilter
from z1_runtime.perception.table_plane import TableConfig, expected_table, fit_table
from z1_runtime.types import JointTrajectory, Observation

_FARTHEST_SEEN_M = 0.8
_OBSTACLE_M = 0.015
_METRES_PER_TURN = 0.35  # 0.35 m of camera travel count as much as 1 rad of turning


class NoViewpointsError(Z1Error, RuntimeError):
    """The arm cannot look at the board from enough sides."""

    default_code = "no_viewpoints"


ROOMY = CollisionConfig(transfer_threshold_m=0.010, table_margin_m=0.020, link_margin_m=0.020)
"""Distances kept while the mount is not calibrated yet."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewpointConfig:
    """Which views are wanted."""

    n: int = 20
    """How many."""
    distance_m: tuple[float, float] = (0.17, 0.38)
    """From the camera to the board along the optical axis [m]; the D405 is sharp from 0.07 to 0.5 m."""
    max_tilt_deg: float = 50.0
    """Largest angle between the optical axis and the board's normal [°]."""
    min_seen: float = 0.6
    """Share of the board's corners that must be in the picture and not behind the gripper."""
    border_px: float = 12.0
    """Corners nearer than this to the picture's border do not count: the mount may be off its drawing."""
    n_drawn: int = 1500
    """Views drawn, of which the best are chosen."""
    jaw: float = z1.GRIPPER_CLOSED
    """Mover angle while looking [rad]; closed hides least."""

    def __post_init__(self) -> None:
        low, high = self.distance_m
        if not (1 <= self.n <= self.n_drawn and 0.07 <= low < high <= 0.6 and 0.0 < self.max_tilt_deg <= 70.0):
            raise InvalidValueError(
                f"n is {self.n}, distance_m {self.distance_m}, max_tilt_deg {self.max_tilt_deg}; allowed are 1 to "
                f"{self.n_drawn} views, 0.07 to 0.6 m, and above 0 to 70°."
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Viewpoint:
    """One place to look from."""

    q: np.ndarray
    """(7,) joint positions [rad]."""
    T_base_camera: np.ndarray
    """(4, 4) where the camera would be by the mount assumed."""
    seen: float
    """Share of the corners that should be seen."""


def look_around(
    kinematics: Kinematics,
    frame: RgbdFrame,
    q: np.ndarray,
    T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA,
    config: CollisionConfig | None = None,
) -> CollisionChecker:
    """Return what to keep away from: the table and whatever stood higher in `frame`, taken at joints `q` (7,) [rad].

    Raises:
        NoTableError: the table is not in view.
    """
    T_base_camera = kinematics.flange(q[: z1.N_ARM]) @ T_flange_camera
    depth = SelfFilter().mask_gripper(frame, float(q[-1]), T_flange_camera).depth_m
    seen = valid_pixels(depth, _FARTHEST_SEEN_M) & continuous_pixels(depth)
    points = back_project(depth, frame.intrinsics, seen)
    # Fitted, not assumed: a mount that is off its drawing tilts the table, and its far end would be an obstacle
    fit = fit_table(points, expected_table(T_base_camera), TableConfig())
    return _checker(kinematics, frame, T_base_camera, points[fit.above(points, _OBSTACLE_M)], q, config or ROOMY)


def table_only(kinematics: Kinematics, frame: RgbdFrame, q: np.ndarray) -> CollisionChecker:
    """Return what lets the arm at joints `q` (7,) [rad] go wherever it does not hit the table: for the way home."""
    touching = CollisionConfig(table_margin_m=0.0, link_margin_m=0.0)
    return _checker(kinematics, frame, kinematics.flange(q[: z1.N_ARM]), np.empty((0, 3)), q, touching)


def _checker(  # noqa: PLR0917 - the order of what is known: who, saw what, from where
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
    taken: Sequence[np.ndarray] = (),
    config: ViewpointConfig | None = None,
    seed: int = 0,
) -> list[Viewpoint]:
    """Return `config.n` views in the order of a short tour from `q_start` (7,) [rad].

    Args:
        kinematics: of the arm.
        checker: says what is hit.
        intrinsics: of the camera.
        T_base_board: (4, 4) about where the board lies, z into it.
        corners_m: (N, 3) its corners in its own frame [m].
        q_start: where the tour begins.
        T_flange_camera: (4, 4) the mount as far as it is known.
        taken: camera poses (4, 4) of views that there are already; the new ones keep away from them.
        config: which views are wanted.
        seed: of the draws; the same arguments give the same views.

    Raises:
        NoViewpointsError: fewer than wanted are within reach and free; the message counts why.
    """
    config = config or ViewpointConfig()
    rng = np.random.default_rng(seed)
    hidden = SelfFilter().reach_m(intrinsics, config.jaw, T_flange_camera) > 0.0
    T_camera_pivot = inverse(T_flange_camera) @ z1.T_FLANGE_PIVOT
    refused = dict.fromkeys(("out of view", "out of reach", "collision"), 0)
    found: list[Viewpoint] = []
    for T_base_camera in _draw_views(T_base_board, corners_m, config, rng):
        seen = _share_seen(intrinsics, hidden, inverse(T_base_camera) @ T_base_board, corners_m, config.border_px)
        if seen < config.min_seen:
            refused["out of view"] += 1
            continue
        branches = kinematics.solve(T_base_camera @ T_camera_pivot)
        if not branches:
            refused["out of reach"] += 1
            continue
        q = np.append(min(branches, key=lambda q: float(np.sum((q - z1.Q_HOME) ** 2))), config.jaw)
        if checker.check_posture(q) is not None or not _is_clear(checker, kinematics, q):
            refused["collision"] += 1
            continue
        found.append(Viewpoint(q=q, T_base_camera=T_base_camera, seen=seen))
    if len(found) < config.n:
        why = ", ".join(f"{count} {reason}" for reason, count in refused.items())
        raise NoViewpointsError(
            f"only {len(found)} of {config.n_drawn} views of the board can be taken, {config.n} are wanted ({why}). "
            "Lay the board flat, 0.35 to 0.5 m in front of the arm, clear the table around it, or ask for fewer poses."
        )
    return _tour(_spread(found, config.n, taken), q_start)


def plan_way(
    checker: CollisionChecker, q_from: np.ndarray, q_to: np.ndarray, limits: MotionLimits
) -> JointTrajectory | None:
    """Return a free motion between two joint vectors (7,) [rad], direct or by way of home; None if both are blocked."""
    near_m = checker.config.transfer_threshold_m
    for via in ([], [np.append(z1.Q_HOME, q_to[-1])]):
        way = joint_path(np.array([q_from, *via, q_to]), limits)
        if checker.check_trajectory(way, threshold_m=near_m) is None:
            return way
    return None


def _draw_views(
    T_base_board: np.ndarray, corners_m: np.ndarray, config: ViewpointConfig, rng: np.random.Generator
) -> list[np.ndarray]:
    """Return camera poses (4, 4) in base that look at some point of the board, from any side, rolled at random."""
    middle, half = corners_m.mean(axis=0), np.ptp(corners_m, axis=0) / 2
    views = []
    for _ in range(config.n_drawn):
        aim = middle + half * [*rng.uniform(-0.6, 0.6, 2), 0.0]
        # Even over the angle, not over the sphere: steep views are worth as much as the many flat ones
        tilt, azimuth, roll = rng.uniform(0, np.deg2rad(config.max_tilt_deg)), *rng.uniform(-np.pi, np.pi, 2)
        turn = Rotation.from_rotvec(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
        R = (turn * Rotation.from_euler("z", roll)).as_matrix()
        views.append(T_base_board @ make_pose(R, aim - rng.uniform(*config.distance_m) * R[:, 2]))
    return views


def _share_seen(
    i: Intrinsics, hidden: np.ndarray, T_camera_board: np.ndarray, corners_m: np.ndarray, border_px: float
) -> float:
    points = transform_points(T_camera_board, corners_m)
    if (points[:, 2] <= 0.0).any():
        return 0.0
    u = i.fx * points[:, 0] / points[:, 2] + i.cx
    v = i.fy * points[:, 1] / points[:, 2] + i.cy
    inside = (u >= border_px) & (u < i.width - border_px) & (v >= border_px) & (v < i.height - border_px)
    inside[inside] = ~hidden[v[inside].astype(int), u[inside].astype(int)]
    return float(inside.mean())


def _is_clear(checker: CollisionChecker, kinematics: Kinematics, q: np.ndarray) -> bool:
    pivot = kinematics.pivot(q[: z1.N_ARM])[None]
    hits = checker.check_grippers(pivot, q[-1:], scene_threshold_m=checker.config.transfer_threshold_m)
    return bool(hits.free()[0])


def _spread(views: Sequence[Viewpoint], n: int, taken: Sequence[np.ndarray]) -> list[Viewpoint]:
    """Return `n` of `views`, each the farthest from all before it: those taken, or else the one that sees most."""
    Ts = np.array([view.T_base_camera for view in views])
    nearest = np.full(len(views), np.inf)
    for T in taken:
        nearest = np.minimum(nearest, _distances(Ts, T))
    chosen: list[int] = []
    while len(chosen) < n:
        chosen.append(int(nearest.argmax() if np.isfinite(nearest).all() else np.argmax([view.seen for view in views])))
        nearest = np.minimum(nearest, _distances(Ts, Ts[chosen[-1]]))
    return [views[index] for index in chosen]


def _distances(Ts: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return how different the views (N, 4, 4) are from `T`, (N,) [rad], travel counted as turning."""
    turn = (Rotation.from_matrix(T[:3, :3]).inv() * Rotation.from_matrix(Ts[:, :3, :3])).magnitude()
    return np.hypot(turn, np.linalg.norm(Ts[:, :3, 3] - T[:3, 3], axis=1) / _METRES_PER_TURN)


def _tour(views: list[Viewpoint], q_start: np.ndarray) -> list[Viewpoint]:
    """Return `views` so that each is the nearest in joints to the one before."""
    left, tour, q = list(views), [], q_start
    while left:
        nearest = min(left, key=lambda view, q=q: float(np.abs(view.q - q).max()))
        left.remove(nearest)
        tour.append(nearest)
        q = nearest.q
    return tour
