"""Holds what was seen in colour against the depth: where a mask ends, and whether there is anything at all."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from models.types import Detection
from z1_runtime.perception.point_cloud import box_pixels

_EDGE_PX = 4
"""Masks are a few pixels off at their edge, where what is behind begins."""
_EDGE_M = 0.010
"""An edge pixel this much nearer or farther than all inner ones is not of the object [m]."""
_GAP_PX, _GAP_SHARE = 6, 0.1
"""The surroundings of a mask begin this far from it, and by this share of its size: no nearer, lest they be what the
mask missed of a box's face."""
_RING_PX = 12
"""How wide the surroundings are."""
_FLAT_M, _FLAT_PER_M = 0.005, 0.020
"""What lies this near to the plane around it, `_FLAT_PER_M` z² added for the noise, is printed on it [m, 1/m]."""
_RING_SHARE, _INSIDE_SHARE = 0.5, 0.85
"""So much of the surroundings must lie in one plane, and so much of what was detected: much of a box is background."""
_FEWEST_PX = 60


def trimmed(detection: Detection, depth_m: np.ndarray) -> Detection:
    """Return `detection` without the pixels at its mask's edge that were measured in front of or behind the object.

    Pixels without depth stay, as in the tabletop's masks: holes belong to what is around them.

    Args:
        detection: one without a mask stays as it is.
        depth_m: (H, W), 0 where nothing was measured [m].
    """
    mask = detection.mask
    if mask is None:
        return detection
    inner = _grown(mask, -_EDGE_PX)
    depths = depth_m[inner & (depth_m > 0)]
    if not len(depths):
        return detection  # too thin to have an inside
    nearest, farthest = np.percentile(depths, [1.0, 99.0])
    outside = (depth_m > 0) & ((depth_m < nearest - _EDGE_M) | (depth_m > farthest + _EDGE_M))
    return replace(detection, mask=mask & (inner | ~outside))


def lies_flat(detection: Detection, depth_m: np.ndarray) -> bool:
    """Return whether what was detected lies in the plane of what is around it: a pattern or a shadow, not a thing.

    False where depth cannot tell: too little of it was measured, or the surroundings are no plane.

    Args:
        detection: with a mask, or its box stands for one.
        depth_m: (H, W), 0 where nothing was measured [m].
    """
    mask = detection.mask if detection.mask is not None else box_pixels(depth_m.shape, detection.box_px)
    measured = depth_m > 0
    u_min, v_min, u_max, v_max = detection.box_px
    gap = round(_GAP_PX + _GAP_SHARE * max(u_max - u_min, v_max - v_min))
    ring, inside = _grown(mask, gap + _RING_PX) & ~_grown(mask, gap) & measured, mask & measured
    if min(ring.sum(), inside.sum()) < _FEWEST_PX:
        return False
    # Over the picture, a plane's inverse depth is a plane too
    v, u = np.nonzero(ring)
    plane, *_ = np.linalg.lstsq(np.column_stack([u, v, np.ones(len(u))]), 1.0 / depth_m[ring], rcond=None)
    shares = ((ring, _RING_SHARE), (inside, _INSIDE_SHARE))
    return all(_share_in(plane, pixels, depth_m) > least for pixels, least in shares)


def _share_in(plane: np.ndarray, pixels: np.ndarray, depth_m: np.ndarray) -> float:
    v, u = np.nonzero(pixels)
    z = depth_m[pixels]
    inverse = plane[0] * u + plane[1] * v + plane[2]
    off = np.abs(z - 1.0 / np.maximum(inverse, 1e-3))
    return float(np.mean(off < _FLAT_M + _FLAT_PER_M * z**2))


def _grown(mask: np.ndarray, by_px: int) -> np.ndarray:
    """Return `mask` (H, W) bool grown, or shrunk where `by_px` is negative."""
    kernel = np.ones((2 * abs(by_px) + 1,) * 2, np.uint8)
    if by_px >= 0:
        return cv2.dilate(mask.astype(np.uint8), kernel).astype(bool)
    return cv2.erode(mask.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1).astype(bool)
