"""Which pixels show the robot's own gripper: its meshes at the jaw's angle, projected into the wrist camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.messages import Intrinsics, RgbdFrame
from hal.base.transforms import inverse, transform_points
from hal.base.z1_gripper import moving_jaw_pose
from z1_runtime.geometry.gripper_mesh import gripper_shape

_IN_FRONT_M = 0.02  # nearer to the lens than this are only camera and bracket themselves


@dataclass(frozen=True, slots=True, kw_only=True)
class SelfFilter:
    """The robot's own jaws in the picture; what stands between or behind them is not theirs.

    The margin covers what is left of the calibration's error, the jaw's angle, and depth noise.
    """

    margin_m: float = 0.010
    """What is seen this close to the gripper's surface, aside or behind it, may be the gripper [m]."""

    def __post_init__(self) -> None:
        if not 0.0 < self.margin_m < 0.05:
            raise InvalidValueError(f"margin_m is {self.margin_m}; allowed is above 0 and below 0.05 m.")

    def mask_gripper(self, frame: RgbdFrame, jaw: float, T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA) -> RgbdFrame:
        """Return `frame` with the depth of the gripper, whose mover is at `jaw` [rad], set to "not measured"."""
        own = (frame.depth_m > 0.0) & (frame.depth_m <= self.reach_m(frame.intrinsics, jaw, T_flange_camera))
        return replace(frame, depth_m=np.where(own, 0.0, frame.depth_m))

    def reach_m(
        self, intrinsics: Intrinsics, jaw: float, T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA
    ) -> np.ndarray:
        """Return the (H, W) depth [m] down to which a pixel may show the gripper; 0 where it is not in view."""
        T_camera_pivot = inverse(T_flange_camera) @ z1.T_FLANGE_PIVOT
        shape = gripper_shape()
        points = np.concatenate(
            [
                transform_points(T_camera_pivot, shape.fixed),
                transform_points(T_camera_pivot @ moving_jaw_pose(jaw), shape.mover),
            ]
        )
        points = points[points[:, 2] > _IN_FRONT_M]
        points = points[np.argsort(points[:, 2], kind="stable")]  # the farthest is drawn last, and stays
        u, v = np.rint(intrinsics.project(points)).astype(int).T
        radius_px = np.ceil(self.margin_m * intrinsics.fx / points[:, 2]).astype(int)
        reach = np.zeros((intrinsics.height, intrinsics.width), np.float32)
        seen = (u > -radius_px) & (u < intrinsics.width + radius_px) & (v > -radius_px)
        seen &= v < intrinsics.height + radius_px
        for n in np.flatnonzero(seen):
            centre = (int(u[n]), int(v[n]))
            cv2.circle(reach, centre, int(radius_px[n]), float(points[n, 2] + self.margin_m), cv2.FILLED)
        return reach
