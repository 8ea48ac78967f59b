"""Occluded parts of an object: where its border meets pixels without a measurement, it is not the object's edge."""

from __future__ import annotations

import cv2
import numpy as np

from hal.base.messages import Intrinsics
from z1_runtime.perception.point_cloud import back_project

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
