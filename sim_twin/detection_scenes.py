"""Pictures for a detector: random scenes of the twin with exact masks of bottles, cylinders and boxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from hal import z1
from sim_twin.d405 import measure_colour
from sim_twin.detection_props import CLASSES
from sim_twin.detection_stage import Actor, Stage
from sim_twin.photo import spoil_photo

if TYPE_CHECKING:
    from hal.messages import Intrinsics

LEAST_PIXELS = 600
"""An object that shows fewer pixels at 640×480 is taken out of the scene."""
LEAST_SHARE = 0.45
"""So is one that shows less of its outline, unless it fills `_LARGE_SHARE` of the picture."""
_LARGE_SHARE = 0.15
_END_ON_COS = np.cos(np.deg2rad(25))
"""Nearer to its axis than this, a bottle or a cylinder looks like any disc."""

_NEAREST_M = 0.05  # no corner of an object comes nearer to the lens
_JAW_POINTS = ((0.05, 0, 0), (0.10, 0, 0), (0.14, 0, 0), (0.18, 0, 0), (0.20, 0, 0), (0.03, 0.14, 0))
"""Points of hand and camera in the flange frame that no object may contain [m]."""
_TRIES = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Label:
    """One object that a picture shows."""

    name: str
    """One of `sim_twin.detection_props.CLASSES`."""
    mask: np.ndarray
    """(H, W) bool, its visible pixels."""

    def box(self) -> np.ndarray:
        """Return the visible pixels' bounds (4,): left, top, right, bottom [px], the last two exclusive."""
        rows, columns = np.flatnonzero(self.mask.any(axis=1)), np.flatnonzero(self.mask.any(axis=0))
        return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """One picture and what it shows."""

    colour: np.ndarray
    """(H, W, 3) uint8, RGB."""
    labels: tuple[Label, ...]
    """Nothing else in the picture is a bottle, a cylinder or a box."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneMix:
    """How often a scene is of which kind; shares in [0, 1]."""

    empty: float = 0.1
    """No object at all, only distractors or nothing."""
    wrist: float = 0.75
    """Seen by the wrist camera past the jaws; the others from anywhere."""
    twin_look: float = 0.25
    """In the twin's own colours and light."""
    occluded: float = 0.2
    """Something put in front of the first object on purpose."""


def draw_scene(stage: Stage, rng: np.random.Generator, mix: SceneMix | None = None) -> Picture:
    """Return the picture of a random scene."""
    mix = mix or SceneMix()
    stage.clear()
    by_wrist = rng.random() < mix.wrist
    as_twin = rng.random() < mix.twin_look
    arm = "pieces" if by_wrist else "whole" if rng.random() < 0.25 else "none"
    camera = "wrist" if by_wrist else "free"
    T_base_camera, centre = _place_camera(stage, by_wrist, rng)
    objects = [] if rng.random() < mix.empty else _choose_objects(stage, as_twin, rng)
    places = _place_objects(stage, objects, T_base_camera, centre=centre, by_wrist=by_wrist, rng=rng)
    _place_distractors(stage, places, T_base_camera, centre, rng)
    if places and rng.random() < mix.occluded:
        _place_occluder(stage, places[0], T_base_camera, rng)
    if as_twin:
        stage.dress_as_twin()
    else:
        stage.dress_at_random(rng)
    labels = _see(stage, objects, camera, arm)
    colour = stage.draw(camera, arm, shadows=not as_twin and rng.random() < 0.6)
    if as_twin and rng.random() < 0.6:
        return Picture(colour=measure_colour(colour, int(rng.integers(2**31)), 0), labels=labels)
    return Picture(colour=spoil_photo(colour, rng), labels=labels)


def draw_scenario(
    stage: Stage, name: str, T_base_object: np.ndarray, rng: np.random.Generator, jaw_rad: float = -1.0
) -> Picture:
    """Return the picture from home of one benchmark object at `T_base_object` (4, 4), in a random look."""
    stage.clear()
    stage.set_arm(np.append(z1.Q_HOME, jaw_rad))
    actor = stage.named(name)[0]
    stage.put(actor, T_base_object)
    stage.dress_at_random(rng)
    labels = _see(stage, [actor], "wrist", "pieces")
    return Picture(colour=spoil_photo(stage.draw("wrist", "pieces", shadows=rng.random() < 0.6), rng), labels=labels)


def outline_area(corners: list[np.ndarray], T_base_camera: np.ndarray, intrinsics: Intrinsics) -> float:
    """Return how many pixels parts with those `corners` [(N, 3) in base, each] would cover, nothing hidden.

    Pixels up to one picture beyond the border count as well. Infinite when a corner is nearer than 50 mm.
    """
    height, width = intrinsics.height, intrinsics.width
    canvas = np.zeros((3 * height // 2, 3 * width // 2), np.uint8)  # at half size
    R, t = T_base_camera[:3, :3], T_base_camera[:3, 3]
    for points in corners:
        x, y, z = ((points - t) @ R).T
        if z.min() < _NEAREST_M:
            return np.inf
        pixels = np.column_stack([x / z * intrinsics.fx + intrinsics.cx, y / z * intrinsics.fy + intrinsics.cy])
        hull = cv2.convexHull(((pixels + np.array([width, height])) / 2).astype(np.float32))
        cv2.fillConvexPoly(canvas, np.round(np.clip(hull, -9999, 9999)).astype(np.int32), 1)
    return 4.0 * float(canvas.sum())


def _see(stage: Stage, objects: list[Actor], camera: str, arm: str) -> tuple[Label, ...]:
    """Return the visible objects' labels; what shows too little is taken off the stage, and the rest seen again."""
    shown = list(objects)
    T_base_camera = stage.T_base_camera(camera)
    while True:
        instances = stage.draw_instances(camera, arm)
        pixels = {id(actor): instances == stage.actors.index(actor) for actor in shown}
        hardly = [actor for actor in shown if _shows_too_little(stage, actor, pixels[id(actor)], T_base_camera)]
        if not hardly:
            return tuple(Label(name=actor.prop.kind, mask=pixels[id(actor)]) for actor in shown)
        for actor in hardly:
            stage.hide(actor)
            shown.remove(actor)


def _shows_too_little(stage: Stage, actor: Actor, mask: np.ndarray, T_base_camera: np.ndarray) -> bool:
    seen = int(mask.sum())
    if seen < LEAST_PIXELS:
        return True
    pose = stage.pose(actor)
    corners = [points @ pose[:3, :3].T + pose[:3, 3] for points in actor.prop.corners()]
    area = outline_area(corners, T_base_camera, stage.intrinsics)
    if np.isinf(area):
        return True
    return seen < LEAST_SHARE * area and seen < _LARGE_SHARE * mask.size


def _place_camera(stage: Stage, by_wrist: bool, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return T_base_camera (4, 4) and the point (3,) it looks at, mid-height of a thing on the table."""
    for _ in range(1000):
        if by_wrist:
            pose = stage.set_arm(_random_joints(rng))
        else:
            stage.set_arm(_random_joints(rng))
            pose = _random_view(rng)
            stage.set_free_camera(pose)
        centre = _look_at(stage, pose, rng)
        if centre is not None and (not by_wrist or _hand_is_clear_of_table(stage)):
            return pose, centre
    raise RuntimeError("no camera pose found in 1000 tries")


def _random_joints(rng: np.random.Generator) -> np.ndarray:
    """Joint positions (7,): a third near home, the others reaching out, nose between 25° up and 50° down."""
    q = np.append(z1.Q_HOME, rng.uniform(-1.45, 0.0) if rng.random() < 0.6 else -1.0)
    if rng.random() < 0.35:
        q[:6] += rng.normal(0.0, 0.12, 6)
    else:
        q[0], q[4] = rng.normal(0.0, 0.35), rng.normal(0.0, 0.25)
        q[1], q[2] = rng.uniform(0.7, 2.6), rng.uniform(-2.5, -0.2)
        q[3] = rng.normal(0.25, 0.3) - q[1] - q[2]
        turned = rng.random()
        q[5] = np.pi / 2 + rng.normal(0.0, 0.2) - (np.pi if turned < 0.12 else 0.0)
        if turned > 0.8:
            q[5] = rng.uniform(-2.7, 2.7)
    return np.clip(q, z1.Q_MIN, z1.Q_MAX)


def _random_view(rng: np.random.Generator) -> np.ndarray:
    """A camera pose (4, 4) around the table's middle, mostly upright."""
    target = np.array([rng.uniform(0.25, 0.75), rng.uniform(-0.3, 0.3), rng.uniform(0.02, 0.15)])
    azimuth, elevation = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.triangular(0, 20, 60))
    c = np.cos(elevation)
    away = np.array([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)])
    place = target + rng.uniform(0.22, 0.75) * away
    place[2] = max(place[2], 0.02)
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    roll = rng.uniform(-np.pi, np.pi) if rng.random() < 0.15 else rng.normal(0.0, 0.15)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1] = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    pose[:3, 2], pose[:3, 3] = forward, place
    return pose


def _look_at(stage: Stage, T_base_camera: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """Return where a ray through a random pixel meets mid-height above the table, 0.13 to 0.85 m off; or None."""
    i = stage.intrinsics
    u, v = rng.uniform(0.08, 0.92) * i.width, rng.uniform(0.15, 0.85) * i.height
    ray = T_base_camera[:3, :3] @ [(u - i.cx) / i.fx, (v - i.cy) / i.fy, 1.0]
    place = T_base_camera[:3, 3]
    if abs(ray[2]) < 0.02:
        return None
    centre = place + (0.075 - place[2]) / ray[2] * ray
    depth = float((centre - place) @ T_base_camera[:3, 2])
    on_table = -0.2 < centre[0] < 0.95 and abs(centre[1]) < 0.55
    return centre if 0.13 < depth < 0.85 and on_table else None


def _hand_is_clear_of_table(stage: Stage) -> bool:
    flange = stage.data.body("link06")
    points = np.array(_JAW_POINTS) @ flange.xmat.reshape(3, 3).T + flange.xpos
    return bool(points[:, 2].min() > 0.012)


def _choose_objects(stage: Stage, as_twin: bool, rng: np.random.Generator) -> list[Actor]:
    """One to three objects; in the twin's look always the benchmark's own."""
    chosen: list[Actor] = []
    for _ in range(rng.choice([1, 2, 3], p=[0.55, 0.3, 0.15])):
        actors = stage.named(str(rng.choice(CLASSES)))
        nominal = as_twin or rng.random() < 0.35
        actor = actors[0] if nominal else actors[rng.integers(1, len(actors))]
        if actor not in chosen:
            chosen.append(actor)
    return chosen


def _random_lean(rng: np.random.Generator) -> np.ndarray:
    """A rotation (3, 3): standing, leaning up to 60° or lying, turned anyhow about the vertical."""
    kind = rng.random()
    lean = 0.0 if kind < 0.4 else rng.uniform(-np.pi / 3, np.pi / 3) if kind < 0.8 else np.pi / 2
    about = 0.0 if rng.random() < 0.5 else rng.uniform(-np.pi, np.pi)  # half of them lean to or from the arm
    own = rng.uniform(-np.pi, np.pi)
    return _about_z(about) @ _about_y(lean) @ _about_z(-about if lean else 0.0) @ _about_z(own)


def _about_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _standing_at(actor: Actor, xy: np.ndarray, R: np.ndarray, above_m: float = 0.0) -> np.ndarray:
    """Return the pose (4, 4) turned by `R`, the lowest point `above_m` over the table."""
    pose = np.eye(4)
    pose[:3, :3] = R
    lowest = (np.vstack(actor.prop.corners()) @ R[2]).min()
    pose[:3, 3] = [xy[0], xy[1], above_m - lowest]
    return pose


def _place_objects(
    stage: Stage,
    objects: list[Actor],
    T_base_camera: np.ndarray,
    *,
    centre: np.ndarray,
    by_wrist: bool,
    rng: np.random.Generator,
) -> list[np.ndarray]:
    """Put the first object at `centre`, the others near it; return the poses of those that fit, which stay."""
    poses: list[np.ndarray] = []
    for actor in list(objects):
        for _ in range(_TRIES):
            spread = 0.01 if not poses else 0.16
            xy = centre[:2] + rng.normal(0.0, spread, 2)
            above = rng.uniform(0.01, 0.15) if rng.random() < 0.08 else 0.0  # lifted, or falling
            pose = _standing_at(actor, xy, _random_lean(rng), above)
            if _fits(stage, actor, pose, others=poses, T_base_camera=T_base_camera, by_wrist=by_wrist):
                stage.put(actor, pose)
                poses.append(pose)
                break
        else:
            objects.remove(actor)
    return poses


def _fits(
    stage: Stage,
    actor: Actor,
    pose: np.ndarray,
    *,
    others: list[np.ndarray],
    T_base_camera: np.ndarray,
    by_wrist: bool,
) -> bool:
    """True when the object is on the table, clear of lens, hand and the other objects' middles."""
    if not (-0.25 < pose[0, 3] < 0.97 and abs(pose[1, 3]) < 0.57):
        return False
    if any(np.linalg.norm(pose[:3, 3] - other[:3, 3]) < 0.085 for other in others):
        return False
    corners = np.vstack(actor.prop.corners())
    depths = (corners @ pose[:3, :3].T + pose[:3, 3] - T_base_camera[:3, 3]) @ T_base_camera[:3, 2]
    if depths.min() < _NEAREST_M or _is_end_on(actor, pose, T_base_camera[:3, 3]):
        return False
    if not by_wrist:
        return True
    flange = stage.data.body("link06")
    points = np.array(_JAW_POINTS) @ flange.xmat.reshape(3, 3).T + flange.xpos
    inside = (points - pose[:3, 3]) @ pose[:3, :3]
    low, high = corners.min(axis=0) - 0.012, corners.max(axis=0) + 0.012
    return not bool(np.all((inside > low) & (inside < high), axis=1).any())


def _is_end_on(actor: Actor, pose: np.ndarray, lens: np.ndarray) -> bool:
    ray = pose[:3, 3] - lens
    return actor.prop.kind != "box" and abs(float(ray @ pose[:3, 2])) > _END_ON_COS * float(np.linalg.norm(ray))


def _place_distractors(
    stage: Stage, places: list[np.ndarray], T_base_camera: np.ndarray, centre: np.ndarray, rng: np.random.Generator
) -> None:
    others = stage.distractors()
    for number in rng.permutation(len(others))[: min(rng.poisson(2.0), 7)]:
        actor = others[number]
        for _ in range(_TRIES):
            xy = centre[:2] + rng.normal(0.0, 0.18, 2)
            pose = _standing_at(actor, xy, _random_lean(rng))
            apart = all(np.linalg.norm(pose[:2, 3] - place[:2, 3]) > 0.09 for place in places)
            if apart and np.linalg.norm(pose[:3, 3] - T_base_camera[:3, 3]) > 0.16 and abs(pose[1, 3]) < 0.57:
                stage.put(actor, pose)
                break


def _place_occluder(
    stage: Stage, T_base_object: np.ndarray, T_base_camera: np.ndarray, rng: np.random.Generator
) -> None:
    """Put a distractor on the way from the lens to the object, a little aside."""
    actor = stage.distractors()[rng.integers(len(stage.distractors()))]
    way = T_base_object[:3, 3] - T_base_camera[:3, 3]
    far = float(np.linalg.norm(way))
    if far < 0.25:
        return
    aside = T_base_camera[:3, :2] @ rng.normal(0.0, 0.035, 2)
    pose = np.eye(4)
    pose[:3, :3] = _random_lean(rng)
    pose[:3, 3] = T_base_camera[:3, 3] + way * (1.0 - rng.uniform(0.09, 0.13) / far) + aside
    if np.linalg.norm(pose[:3, 3] - T_base_camera[:3, 3]) > 0.14:
        stage.put(actor, pose)
