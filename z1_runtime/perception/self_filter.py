"""Self-filter: the pixels of the robot's own gripper, from its meshes at the jaw's angle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.messages import Intrinsics, RgbdFrame
from hal.base.transforms import inverse, transform_points
from hal.base.z1_shape import moving_jaw_pose
from z1_runtime.geometry.gripper_mesh import gripper_shape

_MIN_DEPTH_M = 0.02  # surface points nearer to the lens belong to the camera's own housing and bracket


@dataclass(frozen=True, slots=True, kw_only=True)
class SelfFilter:
    """Removal of the robot's own jaws; objects between or behind them are kept.

    The margin covers the error of the extrinsics and of the jaw angle, and the depth noise.
    """

    margin_m: float = 0.010
    """Distance from the gripper's surface, sideways or behind it, within which a pixel may be the gripper's [m]."""

    def __post_init__(self) -> None:
        if not 0.0 < self.margin_m < 0.05:
            raise InvalidValueError(f"margin_m is {self.margin_m}; allowed is above 0 and below 0.05 m.", code="margin")

    def mask_gripper(self, frame: RgbdFrame, jaw: float, T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA) -> RgbdFrame:
        """Return `frame` with the depth of the gripper, at jaw angle `jaw` [rad], set to "not measured"."""
        return mask_depth(frame, self.gripper_pixels(frame, jaw, T_flange_camera))

    def gripper_pixels(
        self, frame: RgbdFrame, jaw: float, T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA
    ) -> np.ndarray:
        """Return the pixels (H, W) bool that may show the gripper at jaw angle `jaw` [rad]."""
        max_depth_m = self.gripper_depth(frame.intrinsics, jaw, T_flange_camera)
        return (frame.depth_m > 0.0) & (frame.depth_m <= max_depth_m)

    def gripper_depth(self, intrinsics: Intrinsics, jaw: float, T_flange_camera: np.ndarray) -> np.ndarray:
        """Return the depth (H, W) [m] up to which a pixel may show the gripper; 0 where it is not in view."""
        T_camera_pivot = inverse(T_flange_camera) @ z1.T_FLANGE_PIVOT
        shape = gripper_shape()
        points = np.concatenate(
            [
                transform_points(T_camera_pivot, shape.fixed),
                transform_points(T_camera_pivot @ moving_jaw_pose(jaw), shape.moving_jaw),
            ]
        )
        points = points[points[:, 2] > _MIN_DEPTH_M]
        points = points[np.argsort(points[:, 2], kind="stable")]  # the farthest is drawn last, and stays
        u, v = np.rint(intrinsics.project(points)).astype(int).T
        radius_px = np.ceil(self.margin_m * intrinsics.fx / points[:, 2]).astype(int)
        depth_m = np.zeros((intrinsics.height, intrinsics.width), np.float32)
        in_view = (u > -radius_px) & (u < intrinsics.width + radius_px) & (v > -radius_px)
        in_view &= v < intrinsics.height + radius_px
        for n in np.flatnonzero(in_view):
            centre = (int(u[n]), int(v[n]))
            cv2.circle(depth_m, centre, int(radius_px[n]), float(points[n, 2] + self.margin_m), cv2.FILLED)
        return depth_m


def mask_depth(frame: RgbdFrame, pixels: np.ndarray) -> RgbdFrame:
    """Return `frame` with the depth of `pixels` (H, W) bool set to "not measured"."""
    return replace(frame, depth_m=np.where(pixels, 0.0, frame.depth_m))
