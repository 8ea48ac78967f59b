"""Overlays on the wrist camera's picture: mask, box, ranked grasps, the chosen grasp and a caption."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from hal.base.messages import Intrinsics
from z1_runtime.tasks.grasp_selection import GraspSelection
from z1_runtime.visualization.archetypes import gripper_strips

_MASK, _BOX, _CHOSEN = (255, 140, 0), (70, 140, 255), (0, 230, 100)
_N_RANKED = 40
"""Ranked grasps drawn: more of them cover the object in a picture of 480 pixels."""
_NEAR_M = 0.03
"""Points nearer to the camera than this are not projected: the jaws begin at about 0.05 m."""
_EDGES = [(a, b) for a, b in combinations(range(8), 2) if bin(a ^ b).count("1") == 1]
"""Pairs of corners of a box that differ in one sign."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layers:
    """Results that are visible at one moment of the pick."""

    points: bool = False
    box: bool = False
    ranked: bool = False
    chosen: bool = False


def draw_overlay(
    colour: np.ndarray, T_base_camera: np.ndarray, intrinsics: Intrinsics, selection: GraspSelection, layers: Layers
) -> np.ndarray:
    """Return `colour` (H, W, 3) uint8 with `layers` of `selection` as the camera at `T_base_camera` sees them."""
    picture = colour.copy()
    T_base_first = selection.observation.T_base_camera  # of the decision; the camera has moved on since
    if layers.points:
        _draw_points(picture, _project(selection.observation.object_points, T_base_first, T_base_camera, intrinsics))
    if layers.box and selection.ranked.box is not None:
        corners = _project(selection.ranked.box.corners_m, T_base_first, T_base_camera, intrinsics)
        for a, b in _EDGES:
            _draw_line(picture, corners[[a, b]], _BOX, 2)
    if layers.ranked:
        grasps = selection.ranked.grasps[:_N_RANKED]
        strips = gripper_strips(grasps.T_camera_grasps, grasps.widths_m)
        for rank in reversed(range(len(strips))):  # the first-ranked is drawn last, on top
            ratio = rank / _N_RANKED
            strip = _project(strips[rank], T_base_first, T_base_camera, intrinsics)
            _draw_line(picture, strip, (int(40 + 200 * ratio), int(210 * (1 - ratio)), 60), 1)
    if layers.chosen:
        plan = selection.plan
        strip = gripper_strips(plan.T_base_grasp[None], np.array([plan.width_m]))[0]
        _draw_line(picture, _project(strip, np.eye(4), T_base_camera, intrinsics), _CHOSEN, 3)
    return picture


def draw_mask(colour: np.ndarray, mask: np.ndarray | None, box_px: tuple[int, int, int, int]) -> np.ndarray:
    """Return `colour` with a detection's `mask` tinted, and its box."""
    picture = colour.copy()
    if mask is not None:
        picture[mask] = (0.5 * picture[mask] + 0.5 * np.array(_MASK)).astype(np.uint8)
    cv2.rectangle(picture, box_px[:2], box_px[2:], _MASK, 2)
    return picture


def draw_caption(picture: np.ndarray, text: str) -> np.ndarray:
    """Return `picture` with `text` on a dark bar along its upper edge."""
    captioned = picture.copy()
    captioned[:28] = (0.25 * captioned[:28]).astype(np.uint8)
    cv2.putText(captioned, text, (10, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.52, (245, 245, 245), 1, cv2.LINE_AA)
    return captioned


def _project(points: np.ndarray, T_base_points: np.ndarray, T_base_camera: np.ndarray, k: Intrinsics) -> np.ndarray:
    """Return pixels (N, 2) of `points` (N, 3) [m]; NaN for those behind or at the lens."""
    T_camera_points = np.linalg.inv(T_base_camera) @ T_base_points
    in_camera = np.asarray(points, float) @ T_camera_points[:3, :3].T + T_camera_points[:3, 3]
    pixels = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), k.K, np.zeros(4))[0][:, 0]
    pixels[in_camera[:, 2] < _NEAR_M] = np.nan
    return pixels


def _draw_points(picture: np.ndarray, pixels: np.ndarray) -> None:
    pixels = np.round(pixels[np.isfinite(pixels).all(axis=1)]).astype(int)
    height, width = picture.shape[:2]
    inside = ((pixels >= 0) & (pixels < [width - 1, height - 1])).all(axis=1)  # less one pixel, as 2 × 2 are drawn
    u, v = pixels[inside].T
    for du, dv in np.ndindex(2, 2):  # 2 × 2 pixels: the picture is shown at three quarters of the camera's size
        picture[v + dv, u + du] = _MASK


def _draw_line(picture: np.ndarray, pixels: np.ndarray, colour: tuple[int, int, int], thickness: int) -> None:
    if np.isfinite(pixels).all() and np.abs(pixels).max() < 10_000:  # OpenCV's fixed-point lines overflow beyond
        points = np.round(pixels).astype(np.int32)
        cv2.polylines(picture, [points], False, colour, thickness, cv2.LINE_AA)
