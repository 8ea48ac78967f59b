"""The robot's own gripper in the image, from its meshes at the jaw's angle, and what it may occlude of the object."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.messages import Intrinsics, RgbdFrame
from hal.base.transforms import inverse, transform_points
from hal.base.z1 import moving_jaw_pose
from z1_runtime.geometry.gripper_geometry import gripper_shape
from z1_runtime.perception.point_cloud import back_project

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


REACH_M = 0.015
"""Distance to which the object is assumed to continue [m]."""
MAX_POINTS = 1500
"""Maximum number of points returned: each is tested against the gripper as an object's own."""
_THIN_PX = 17  # narrower gaps come from the stereo matching: holes, and the shadow left of a near edge
_TOUCH_PX = 5  # a gap that touches the object begins within this distance, past the pixels that filters removed


def occluded_points(depth_m: np.ndarray, intrinsics: Intrinsics, solid: np.ndarray) -> np.ndarray:
    """Return points (K, 3) in the camera frame [m] where the object may continue behind the gripper or a dark spot.

    They extend the object's depth into unmeasured pixels, up to `REACH_M` from its border.

    Args:
        depth_m: (H, W), 0 where nothing was measured or the robot's own gripper is.
        intrinsics: of that image.
        solid: (H, W) bool, the object's measured pixels.
    """
    if not solid.any():
        return np.zeros((0, 3))
    gaps = cv2.morphologyEx((depth_m <= 0.0).astype(np.uint8), cv2.MORPH_OPEN, _square(_THIN_PX))
    distance, label = cv2.distanceTransformWithLabels(
        (~solid).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = np.asarray(label, dtype=np.intp)
    reach_px = REACH_M * intrinsics.fx / float(np.median(depth_m[solid]))
    near = (gaps > 0) & (distance < reach_px)
    # Only gaps that begin at the object itself: one that the table separates from it occludes no more of it
    touches = np.zeros(label.max() + 1, bool)
    touches[label[near & (distance < _TOUCH_PX)]] = True
    occluded = near & touches[label]
    if not occluded.any():
        return np.zeros((0, 3))
    depth_of = np.zeros(label.max() + 1)
    depth_of[label[solid]] = depth_m[solid]
    points = back_project(depth_of[label], intrinsics, occluded)
    return points[:: -(-len(points) // MAX_POINTS)]


def _square(size_px: int) -> np.ndarray:
    return np.ones((size_px, size_px), np.uint8)
