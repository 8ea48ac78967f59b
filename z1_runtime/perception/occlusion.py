"""Where an object may go on unseen: its border meets pixels that measured nothing, so it is not the object's edge."""

from __future__ import annotations

import cv2
import numpy as np

from hal.base.messages import Intrinsics
from z1_runtime.perception.point_cloud import back_project

REACH_M = 0.015
"""How far the object is thought to go on [m]."""
MAX_POINTS = 1500
_THIN_PX = 17  # narrower gaps are the stereo's own: holes, and the shadow beside a near edge
_TOUCH_PX = 5


def occluded_points(depth_m: np.ndarray, intrinsics: Intrinsics, solid: np.ndarray) -> np.ndarray:
    """Return points (K, 3) in the camera frame [m] where the object may go on behind the gripper or a dark spot.

    They continue the object's depth into what was not measured, up to `REACH_M` from its border.

    Args:
        depth_m: (H, W), 0 where nothing was measured or the robot's own gripper is.
        intrinsics: of that image.
        solid: (H, W) bool, the object's measured pixels.
    """
    if not solid.any():
        return np.zeros((0, 3))
    gaps = cv2.morphologyEx((depth_m <= 0.0).astype(np.uint8), cv2.MORPH_OPEN, _square(_THIN_PX))
    away, label = cv2.distanceTransformWithLabels(
        (~solid).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = np.asarray(label, dtype=np.intp)
    reach_px = REACH_M * intrinsics.fx / float(np.median(depth_m[solid]))
    near = (gaps > 0) & (away < reach_px)
    # Only where the gap begins at the object itself: one that the table separates from it hides no more of it
    meets = np.zeros(label.max() + 1, bool)
    meets[label[near & (away < _TOUCH_PX)]] = True
    hidden = near & meets[label]
    if not hidden.any():
        return np.zeros((0, 3))
    depth_of = np.zeros(label.max() + 1)
    depth_of[label[solid]] = depth_m[solid]
    points = back_project(depth_of[label], intrinsics, hidden)
    return points[:: -(-len(points) // MAX_POINTS)]


def _square(size_px: int) -> np.ndarray:
    return np.ones((size_px, size_px), np.uint8)
