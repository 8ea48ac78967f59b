"""Images for a detector: random scenes of the twin with exact masks of bottles, cylinders and boxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from hal.base import z1
from hal.base.transforms import transform_points
from sim_twin.camera.d405 import measure_colour
from sim_twin.detection_data.appearance import apply_twin_appearance, randomize_appearance
from sim_twin.detection_data.photometric_noise import augment_image
from sim_twin.detection_data.placement import (
    NEAREST_M,
    choose_objects,
    place_camera,
    place_distractors,
    place_objects,
    place_occluder,
)
from sim_twin.detection_data.scene_renderer import PropInstance, SceneRenderer

if TYPE_CHECKING:
    from hal.base.messages import Intrinsics

Appearance = Literal["twin", "own", "any"]
"""Appearance of a scene: all as in the twin; our objects in their own colours, the rest random; all random."""
MIN_PIXELS = 600
"""Minimum visible pixels of an object at 640×480; one with fewer is removed from the scene."""
MIN_VISIBLE_RATIO = 0.5
"""Minimum visible ratio of an object's outline, unless it fills `_LARGE_RATIO` of the image."""
MIN_MARK_RATIO = 0.5
"""Minimum visible ratio of a mug's handle, and of the neck of a bottle in random colours: nothing else distinguishes
either from a cylinder."""
_LARGE_RATIO = 0.15


@dataclass(frozen=True, slots=True, kw_only=True)
class Label:
    """One visible object."""

    name: str
    """One of `sim_twin.detection_data.props.CLASSES`."""
    mask: np.ndarray
    """(H, W) bool, its visible pixels."""

    def box(self) -> np.ndarray:
        """Return the visible pixels' bounds (4,): left, top, right, bottom [px], the last two exclusive."""
        rows, columns = np.flatnonzero(self.mask.any(axis=1)), np.flatnonzero(self.mask.any(axis=0))
        return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelledImage:
    """One image with its labels."""

    colour: np.ndarray
    """(H, W, 3) uint8, RGB."""
    labels: tuple[Label, ...]
    """All bottles, cylinders and boxes of the image."""
    appearance: Appearance
    """Appearance of its scene."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneMix:
    """Mix of the kinds of scenes; ratios in [0, 1]."""

    empty: float = 0.1
    """No object at all, only distractors or nothing."""
    wrist: float = 0.85
    """From the wrist camera past the jaws; the others from anywhere."""
    twin: float = 0.35
    """In the twin's own colours and light."""
    own: float = 0.4
    """The objects in their own colours; room, light and distractors random, as the arm will meet them."""
    nominal: float = 0.75
    """Ratio of objects with the benchmark's own measures among random colours; in their own colours all have them."""
    occluded: float = 0.2
    """With an occluder in front of the first object."""
    crowd: float = 0.0
    """Up to eight objects instead of one to three: more labels per image; distractors are then spread, too."""
    distractors: float = 2.0
    """Mean number of distractors in an image; fewer where they do not fit."""


def draw_scene(renderer: SceneRenderer, rng: np.random.Generator, mix: SceneMix | None = None) -> LabelledImage:
    """Return the image of a random scene."""
    mix = mix or SceneMix()
    renderer.clear()
    by_wrist = rng.random() < mix.wrist
    appearance = _choose_appearance(rng, mix)
    arm = "pieces" if by_wrist else "whole" if rng.random() < 0.25 else "none"
    camera = "wrist" if by_wrist else "free"
    T_base_camera, centre = place_camera(renderer, by_wrist, rng)
    crowd = mix.crowd > 0.0 and rng.random() < mix.crowd
    objects = (
        []
        if rng.random() < mix.empty
        else choose_objects(renderer, rng, nominal=mix.nominal if appearance == "any" else 1.0, crowd=crowd)
    )
    end_on = appearance != "any"
    places = place_objects(
        renderer, objects, T_base_camera, centre=centre, by_wrist=by_wrist, crowd=crowd, end_on=end_on, rng=rng
    )
    place_distractors(
        renderer, places, T_base_camera, centre=centre, number=mix.distractors, spread=mix.crowd > 0.0, rng=rng
    )
    if places and rng.random() < mix.occluded:
        place_occluder(renderer, places[0], T_base_camera, rng)
    _apply_appearance(renderer, appearance, objects, rng)
    labels = _label_visible(renderer, objects, camera, arm, by_shape=appearance == "any")
    colour = renderer.draw(camera, arm, shadows=appearance != "twin" and rng.random() < 0.6)
    if appearance == "twin" and rng.random() < 0.6:
        return LabelledImage(
            colour=measure_colour(colour, int(rng.integers(2**31)), 0), labels=labels, appearance=appearance
        )
    return LabelledImage(colour=augment_image(colour, rng), labels=labels, appearance=appearance)


def _choose_appearance(rng: np.random.Generator, mix: SceneMix) -> Appearance:
    number = rng.random()
    return "twin" if number < mix.twin else "own" if number < mix.twin + mix.own else "any"


def draw_scenario(
    renderer: SceneRenderer,
    name: str,
    T_base_object: np.ndarray,
    rng: np.random.Generator,
    *,
    appearance: Appearance,
    jaw_rad: float = -1.0,
) -> LabelledImage:
    """Return the image from home of one benchmark object at `T_base_object` (4, 4), by the light of any room."""
    renderer.clear()
    renderer.set_arm(np.append(z1.Q_HOME, jaw_rad))
    instance = renderer.named(name)[0]
    renderer.put(instance, T_base_object)
    _apply_appearance(renderer, appearance, [instance], rng)
    labels = _label_visible(renderer, [instance], "wrist", "pieces", by_shape=False)
    colour = renderer.draw("wrist", "pieces", shadows=appearance != "twin" and rng.random() < 0.6)
    return LabelledImage(colour=augment_image(colour, rng), labels=labels, appearance=appearance)


def _apply_appearance(
    renderer: SceneRenderer, appearance: Appearance, objects: list[PropInstance], rng: np.random.Generator
) -> None:
    if appearance == "twin":
        apply_twin_appearance(renderer)
    else:
        randomize_appearance(renderer, rng, keep=objects if appearance == "own" else ())


def project_outline(corners: list[np.ndarray], T_base_camera: np.ndarray, intrinsics: Intrinsics) -> np.ndarray | None:
    """Return the unoccluded outline of parts with `corners` [(N, 3) in base, each], at half size.

    The image is the middle third of the result (3 H / 2, 3 W / 2) bool, so that parts up to one image beyond its
    border count as well. None when a corner is nearer than 50 mm.
    """
    height, width = intrinsics.height, intrinsics.width
    canvas = np.zeros((3 * height // 2, 3 * width // 2), np.uint8)
    R, t = T_base_camera[:3, :3], T_base_camera[:3, 3]
    for points in corners:
        in_camera = (points - t) @ R
        if in_camera[:, 2].min() < NEAREST_M:
            return None
        pixels = intrinsics.project(in_camera)
        hull = cv2.convexHull(((pixels + np.array([width, height])) / 2).astype(np.float32))
        # Corners near the lens project far away, where OpenCV's integers would overflow
        cv2.fillConvexPoly(canvas, np.round(np.clip(hull, -9999, 9999)).astype(np.int32), 1)
    return canvas.astype(bool)


def visible_ratio(mask: np.ndarray, whole: np.ndarray) -> float:
    """Return the ratio of an outline (see `project_outline`) that the visible pixels `mask` (H, W) bool cover."""
    height, width = mask.shape[0] // 2, mask.shape[1] // 2
    inside = whole[height : 2 * height, width : 2 * width]
    return np.count_nonzero(inside & mask[::2, ::2]) / max(np.count_nonzero(whole), 1)


def _label_visible(
    renderer: SceneRenderer, objects: list[PropInstance], camera: str, arm: str, *, by_shape: bool
) -> tuple[Label, ...]:
    """Return the visible objects' labels; too occluded objects are removed, and the rest rendered again.

    Args:
        stage: with everything in its place.
        objects: those that may have a label.
        camera: `wrist` or `free`.
        arm: as `SceneRenderer.draw` takes it.
        by_shape: the objects' colours are random, so that only shape identifies them.
    """
    shown = list(objects)
    mugs = [
        instance for instance in renderer.distractors() if instance.prop.kind == "mug" and renderer.is_shown(instance)
    ]
    T_base_camera = renderer.T_base_camera(camera)
    while True:
        instances = renderer.draw_instances(camera, arm)
        pixels = {id(instance): instances == renderer.props.index(instance) for instance in shown + mugs}
        too_occluded = [
            instance
            for instance in shown
            if _is_too_occluded(renderer, instance, pixels[id(instance)], T_base_camera, by_shape)
        ]
        too_occluded += [
            instance for instance in mugs if not _shows_mark(renderer, instance, pixels[id(instance)], T_base_camera)
        ]
        if not too_occluded:
            return tuple(Label(name=instance.prop.kind, mask=pixels[id(instance)]) for instance in shown)
        for instance in too_occluded:
            renderer.hide(instance)
            (mugs if instance in mugs else shown).remove(instance)


def _is_too_occluded(
    renderer: SceneRenderer, instance: PropInstance, mask: np.ndarray, T_base_camera: np.ndarray, by_shape: bool
) -> bool:
    visible = int(mask.sum())
    if visible < MIN_PIXELS:
        return True
    whole = project_outline(_corners_in_base(renderer, instance), T_base_camera, renderer.intrinsics)
    if whole is None:
        return True
    if by_shape and instance.prop.kind == "bottle" and not _shows_mark(renderer, instance, mask, T_base_camera):
        return True
    # An outline at half size has a quarter of the pixels
    return visible < MIN_VISIBLE_RATIO * 4 * int(np.count_nonzero(whole)) and visible < _LARGE_RATIO * mask.size


def _shows_mark(renderer: SceneRenderer, instance: PropInstance, mask: np.ndarray, T_base_camera: np.ndarray) -> bool:
    """True when the pixels `mask` cover enough of a bottle's or a mug's mark: neck and cap, or handle."""
    corners = _corners_in_base(renderer, instance)
    parts = slice(-2, None) if instance.prop.kind == "bottle" else slice(2, None)
    mark = project_outline(corners[parts], T_base_camera, renderer.intrinsics)
    if mark is None:
        return False
    if instance.prop.kind == "mug":  # a handle in front of the mug, or behind it, is not visible
        body = project_outline(corners[:2], T_base_camera, renderer.intrinsics)
        if body is None or np.count_nonzero(mark & ~body) < MIN_MARK_RATIO * np.count_nonzero(mark):
            return False
        mark &= ~body
    return visible_ratio(mask, mark) >= MIN_MARK_RATIO


def _corners_in_base(renderer: SceneRenderer, instance: PropInstance) -> list[np.ndarray]:
    pose = renderer.pose(instance)
    return [transform_points(pose, points) for points in instance.prop.corners()]
