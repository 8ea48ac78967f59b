"""Analytic scenes observed from home: ray-cast table, boxes and cylinders, with the depth errors of a D405."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports] - a .pth file leads to it

from hal.base.messages import Intrinsics, RgbdFrame
from hal.base.z1 import Q_HOME, T_FLANGE_CAMERA, T_FLANGE_PIVOT, mesh_dir, urdf_path

INTRINSICS = Intrinsics(width=640, height=480, fx=382.26, fy=382.26, cx=319.5, cy=239.5)
BASELINE_M = 0.018


@cache
def T_base_camera() -> np.ndarray:
    """Return the (4, 4) camera pose at home, by pinocchio on the URDF."""
    model = pin.buildModelFromUrdf(str(urdf_path()))
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.append(Q_HOME, 0.0))
    return data.oMf[model.getFrameId("link06")].homogeneous @ T_FLANGE_CAMERA


@dataclass(frozen=True)
class Box:
    """Upright box at its centre x, y, turned about the vertical, `bottom_m` above the table."""

    x: float
    y: float
    size: tuple[float, float, float]
    yaw: float = 0.0
    bottom_m: float = 0.0

    def depth(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        o = (origin - [self.x, self.y, self.bottom_m + self.size[2] / 2]) @ R
        half = np.array(self.size) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (-half - o) / (rays @ R), (half - o) / (rays @ R)
        enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
        return np.where((enter < leave) & (enter > 0), enter, np.inf)


@dataclass(frozen=True)
class Cylinder:
    """Upright cylinder on the table."""

    x: float
    y: float
    radius: float
    height: float

    def depth(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        o, d = origin - [self.x, self.y, 0.0], rays
        a = d[..., 0] ** 2 + d[..., 1] ** 2
        b = o[0] * d[..., 0] + o[1] * d[..., 1]
        root = b**2 - a * (o[0] ** 2 + o[1] ** 2 - self.radius**2)
        side = (-b - np.sqrt(np.maximum(root, 0))) / a
        at = o[2] + side * d[..., 2]
        side = np.where((root > 0) & (at >= 0) & (at <= self.height), side, np.inf)
        top = (self.height - o[2]) / d[..., 2]
        hit = o + top[..., None] * d
        top = np.where((hit[..., 0] ** 2 + hit[..., 1] ** 2 <= self.radius**2) & (top > 0), top, np.inf)
        return np.minimum(side, top)


def cast(
    objects: Sequence[Box | Cylinder], tilt_rad: float = 0.0, lift_m: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return exact depth (480, 640) [m], 0 = nothing hit, and the index of the object hit, −1 = table or nothing.

    The table is z = lift_m + x · tan(tilt_rad) in the base frame.
    """
    T = T_base_camera()
    v, u = np.mgrid[: INTRINSICS.height, : INTRINSICS.width]
    rays = np.stack([(u - INTRINSICS.cx) / INTRINSICS.fx, (v - INTRINSICS.cy) / INTRINSICS.fy, np.ones(u.shape)], -1)
    rays = rays @ T[:3, :3].T
    origin = T[:3, 3]
    normal = np.array([-np.sin(tilt_rad), 0, np.cos(tilt_rad)])
    offset = lift_m * np.cos(tilt_rad)
    table = (offset - normal @ origin) / (rays @ normal)
    depths = np.stack([np.where(table > 0, table, np.inf), *(o.depth(origin, rays) for o in objects)])
    which = depths.argmin(axis=0) - 1
    depth = depths.min(axis=0)
    return np.where(depth < 6.5, depth, 0.0), which


@cache
def gripper_depth(jaw: float) -> np.ndarray:
    """Return depth (480, 640) [m] of the gripper alone, its moving jaw at `jaw` [rad]; inf elsewhere."""
    import trimesh

    T_camera_pivot = np.linalg.inv(T_FLANGE_CAMERA) @ T_FLANGE_PIVOT
    T_pivot_stationary_jaw, T_pivot_moving_jaw = np.eye(4), np.eye(4)
    T_pivot_stationary_jaw[0, 3] = -0.049
    T_pivot_moving_jaw[:3, :3] = cv2.Rodrigues(np.array([0.0, jaw, 0.0]))[0]
    depth = np.full((INTRINSICS.height, INTRINSICS.width), np.inf)
    for name, T in (("z1_GripperStator", T_pivot_stationary_jaw), ("z1_GripperMover", T_pivot_moving_jaw)):
        mesh = trimesh.load_mesh(mesh_dir() / "collision" / f"{name}.STL")
        points = trimesh.sample.sample_surface(mesh, 400_000, seed=0)[0]
        x, y, z = (T_camera_pivot @ T @ np.column_stack([points, np.ones(len(points))]).T)[:3]
        u = np.rint(INTRINSICS.fx * x / z + INTRINSICS.cx).astype(int)
        v = np.rint(INTRINSICS.fy * y / z + INTRINSICS.cy).astype(int)
        visible = (z > 0.05) & (u >= 0) & (u < INTRINSICS.width) & (v >= 0) & (v < INTRINSICS.height)
        np.minimum.at(depth, (v[visible], u[visible]), z[visible])
    return depth


def before(near: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Return the depth of what is nearer of two images; 0 in `far` and inf in `near` are nothing."""
    return np.where(np.isfinite(near) & ((far == 0) | (near < far)), near, far)


def d405(depth: np.ndarray, seed: int, noise_px: float = 0.08) -> np.ndarray:
    """Return depth as a D405 measures it: reference/realsense figures for noise, quantisation, band, shadow, edges.

    σ_z = z² · noise_px / (f B), correlated over some pixels; disparity in 1/32 px; invalid left band of f B / z px;
    occlusion shadow left of near objects; flying pixels where the depth jumps; round holes.
    """
    rng = np.random.default_rng(seed)
    f_b = INTRINSICS.fx * BASELINE_M
    with np.errstate(divide="ignore"):
        disparity = np.where(depth > 0, f_b / depth, 0.0)
    smooth = cv2.GaussianBlur(rng.standard_normal(depth.shape), (0, 0), 1.0)
    noisy = np.round(disparity * 32) / 32 + noise_px * smooth / smooth.std()
    z = np.where(depth > 0, f_b / np.maximum(noisy, 1.0), 0.0)

    near = cv2.erode(depth, np.ones((3, 3)))
    far = cv2.dilate(depth, np.ones((3, 3)))
    edge = (far - near > 0.015) & (near > 0)
    mixed = near + rng.random(depth.shape) * (far - near)
    z = np.where(edge & (rng.random(depth.shape) < 0.6), mixed, z)

    columns = np.arange(depth.shape[1])
    for row in range(depth.shape[0]):
        # A pixel is occluded for the right imager if something further right projects to its left there
        right = columns - disparity[row]
        covered = np.minimum.accumulate(right[::-1])[::-1]
        z[row, (right > covered + 0.5) | (right < 0)] = 0.0
    for _ in range(25):
        centre = (int(rng.integers(640)), int(rng.integers(480)))
        cv2.circle(z, centre, int(rng.integers(2, 6)), 0.0, -1)
    return (np.round(z * 1e4) / 1e4).astype(np.float32)


def frame_of(depth: np.ndarray, truth: np.ndarray | None = None) -> RgbdFrame:
    """Return a grey frame with that depth."""
    colour = np.full((*depth.shape, 3), 128, np.uint8)
    return RgbdFrame(
        colour=colour, depth_m=depth, intrinsics=INTRINSICS, stamp_s=0.0, sequence=0, ground_truth_mask=truth
    )


def noisy_frame(objects: Sequence[Box | Cylinder], seed: int = 0, target: int = 0, **table: float) -> RgbdFrame:
    """Return a D405's frame of objects; `target` is the one in the ground-truth mask."""
    depth, which = cast(objects, **table)
    return frame_of(d405(depth, seed), which == target)


def truth(frame: RgbdFrame) -> np.ndarray:
    """Return the ground-truth mask of a frame that has one."""
    assert frame.ground_truth_mask is not None
    return frame.ground_truth_mask
