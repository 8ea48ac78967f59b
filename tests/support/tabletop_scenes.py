"""Analytic scenes for the collision and planner tests: an upright cylinder on a table, observed from home."""

from __future__ import annotations

import numpy as np

from hal.base import z1
from hal.base.messages import Intrinsics, RgbdFrame
from hal.base.transforms import inverse
from models.types import Detection, GraspSet
from z1_runtime.collision.planning_scene import CollisionConfig, PlanningScene
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.gripper_geometry import GripperPlacementConfig
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.beak_gripper import BeakGripper
from z1_runtime.grasping.grasp_candidates import EARLY_EXIT_CHUNK, GraspCandidates
from z1_runtime.planning.config import PlannerConfig
from z1_runtime.types import Observation, Plane

Q_START = np.append(z1.Q_HOME, -1.0)
RADIUS_M, HEIGHT_M = 0.030, 0.150
N_POINTS = 16_000  # 1.3 mm apart, as the D405 sees it at 0.4 m


def camera_pose(kinematics: Kinematics) -> np.ndarray:
    return kinematics.flange(z1.Q_HOME) @ z1.T_FLANGE_CAMERA


def moved(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


def cylinder(x: float, y: float, eye: np.ndarray, radius: float = RADIUS_M, height: float = HEIGHT_M) -> np.ndarray:
    """Return the points of an upright cylinder that are visible from `eye` (3,), base frame."""
    rng = np.random.default_rng(0)
    angle, z = rng.uniform(0.0, 2.0 * np.pi, N_POINTS), rng.uniform(0.008, height, N_POINTS)
    outward = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(N_POINTS)])
    side = radius * outward + np.column_stack([np.full(N_POINTS, x), np.full(N_POINTS, y), z])
    return side[np.sum((eye - side) * outward, axis=1) > 0.0]


def table_points() -> np.ndarray:
    xy = np.stack(np.meshgrid(np.arange(0.2, 0.9, 0.004), np.arange(-0.4, 0.4, 0.004)), axis=-1).reshape(-1, 2)
    return np.column_stack([xy, np.random.default_rng(1).normal(0.0, 0.001, len(xy))])


def wall(x: float, y: float, height: float = 0.25) -> np.ndarray:
    """Return a plate 80 mm wide across base x, standing at (x, y)."""
    across, up = np.meshgrid(np.arange(-0.04, 0.04, 0.002), np.arange(0.01, height, 0.002))
    return np.column_stack([np.full(across.size, x), y + across.ravel(), up.ravel()])


def make_observation(T_base_camera: np.ndarray, object_points: np.ndarray, *scene: np.ndarray) -> Observation:
    intrinsics = Intrinsics(width=4, height=3, fx=4.0, fy=4.0, cx=1.5, cy=1.0)
    frame = RgbdFrame(
        colour=np.zeros((3, 4, 3)), depth_m=np.zeros((3, 4)), intrinsics=intrinsics, stamp_s=0.0, sequence=0
    )
    T_camera_base = inverse(T_base_camera)
    up = T_camera_base[:3, 2]
    return Observation(
        frame=frame,
        T_base_camera=T_base_camera,
        detection=Detection(label="cylinder", confidence=1.0, box_px=(0, 0, 1, 1)),
        object_points=moved(T_camera_base, object_points),
        scene_points=moved(T_camera_base, np.vstack([table_points(), *scene])),
        table=Plane(normal=up, offset_m=float(up @ T_camera_base[:3, 3])),
    )


def frontal(x: float, y: float, z: float, pitch_rad: float, yaw_rad: float | None = None) -> np.ndarray:
    """Return a grasp (4, 4) of an upright object's axis at (x, y, z): closing level, approach pitched down."""
    yaw = np.arctan2(y, x) if yaw_rad is None else yaw_rad
    c, s = np.cos(pitch_rad), np.sin(pitch_rad)
    approach = np.array([c * np.cos(yaw), c * np.sin(yaw), -s])
    opening = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    T = np.eye(4)
    T[:3, :3] = np.column_stack([np.cross(opening, approach), opening, approach])
    T[:3, 3] = np.array([x, y, z]) + GripperPlacementConfig().contact_depth_m * approach
    return T


def in_camera(T_base_camera: np.ndarray, grasps: list[np.ndarray], width_m: float = 2.0 * RADIUS_M) -> GraspSet:
    return GraspSet(
        T_camera_grasps=inverse(T_base_camera) @ np.array(grasps),
        scores=np.ones(len(grasps)),
        widths_m=np.full(len(grasps), width_m),
    )


def make_checker(
    kinematics: Kinematics,
    observation: Observation,
    q: np.ndarray | None = Q_START,
    config: CollisionConfig | None = None,
) -> CollisionChecker:
    """Return the collision checks in the scene of `observation`, taken at joints `q` (7,)."""
    return CollisionChecker(kinematics, PlanningScene.from_observation(observation, q, kinematics, config))


def make_candidates(
    kinematics: Kinematics,
    grasps: GraspSet,
    observation: Observation,
    config: PlannerConfig | None = None,
    chunk: int | None = EARLY_EXIT_CHUNK,
) -> GraspCandidates:
    """Return `grasps` (camera frame) as candidates in the scene of `observation`."""
    config = config or PlannerConfig()
    checker = make_checker(kinematics, observation, config=config.collision)
    gripper = BeakGripper(config.gripper)
    return GraspCandidates.from_grasps(grasps, checker, gripper, fallback_width_m=config.fallback_width_m, chunk=chunk)
