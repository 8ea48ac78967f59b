"""Poses of camera, objects and distractors in a detector's image."""

from __future__ import annotations

import numpy as np

from hal.base import z1
from sim_twin.detection_data.props import CLASSES
from sim_twin.detection_data.scene_renderer import PropInstance, SceneRenderer

NEAREST_M = 0.05
"""Minimum distance of an object's corners from the lens [m]."""
_JAW_POINTS = ((0.05, 0, 0), (0.10, 0, 0), (0.14, 0, 0), (0.18, 0, 0), (0.20, 0, 0), (0.03, 0.14, 0))
"""Points of gripper and camera in the flange frame that no object may contain [m]."""
_END_ON_COS = np.cos(np.deg2rad(25))
"""Cosine above which a view along its axis shows a bottle or a cylinder as any disc."""
_TRIES = 60


def place_camera(renderer: SceneRenderer, by_wrist: bool, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return T_base_camera (4, 4) and the point (3,) in view, mid-height of an object on the table."""
    for _ in range(1000):
        if by_wrist:
            pose = renderer.set_arm(_random_joints(rng))
        else:
            renderer.set_arm(_random_joints(rng))
            pose = _random_view(rng)
            renderer.set_free_camera(pose)
        centre = _choose_target(renderer, pose, rng)
        if centre is not None and (not by_wrist or _gripper_clears_table(renderer)):
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
        # Joints 2 to 4 turn about parallel axes: their sum is the pitch of the nose
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
    direction = np.array([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)])
    place = target + rng.uniform(0.22, 0.75) * direction
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


def _choose_target(renderer: SceneRenderer, T_base_camera: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """Return the point (3,) of a random pixel's ray at mid-height above the table, 0.13 to 0.85 m deep; or None."""
    i = renderer.intrinsics
    u, v = rng.uniform(0.08, 0.92) * i.width, rng.uniform(0.15, 0.85) * i.height
    ray = T_base_camera[:3, :3] @ i.deproject(np.array([u]), np.array([v]), np.ones(1))[0]
    place = T_base_camera[:3, 3]
    # A nearly level ray meets the table far beyond its edge
    if abs(ray[2]) < 0.02:
        return None
    # 75 mm is half the height of the benchmark's box and cylinder
    centre = place + (0.075 - place[2]) / ray[2] * ray
    depth = float((centre - place) @ T_base_camera[:3, 2])
    on_table = -0.2 < centre[0] < 0.95 and abs(centre[1]) < 0.55
    return centre if 0.13 < depth < 0.85 and on_table else None


def _gripper_clears_table(renderer: SceneRenderer) -> bool:
    flange = renderer.data.body("link06")
    points = np.array(_JAW_POINTS) @ flange.xmat.reshape(3, 3).T + flange.xpos
    return bool(points[:, 2].min() > 0.012)


def choose_objects(
    renderer: SceneRenderer, rng: np.random.Generator, *, nominal: float, crowd: bool
) -> list[PropInstance]:
    """One to three objects, or up to eight; the ratio `nominal` of them are the benchmark's own."""
    chosen: list[PropInstance] = []
    for _ in range(rng.integers(6, 12) if crowd else rng.choice([1, 2, 3], p=[0.55, 0.3, 0.15])):
        props = renderer.named(str(rng.choice(CLASSES)))
        instance = props[0] if rng.random() < nominal else props[rng.integers(1, len(props))]
        if instance not in chosen:
            chosen.append(instance)
    return chosen


def _random_lean(rng: np.random.Generator) -> np.ndarray:
    """Return a rotation (3, 3): upright, leaning up to 60° or horizontal, at any angle about the vertical."""
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


def _pose_on_table(instance: PropInstance, xy: np.ndarray, R: np.ndarray, above_m: float = 0.0) -> np.ndarray:
    """Return the pose (4, 4) turned by `R`, the lowest point `above_m` over the table."""
    pose = np.eye(4)
    pose[:3, :3] = R
    lowest = (np.vstack(instance.prop.corners()) @ R[2]).min()
    pose[:3, 3] = [xy[0], xy[1], above_m - lowest]
    return pose


def place_objects(
    renderer: SceneRenderer,
    objects: list[PropInstance],
    T_base_camera: np.ndarray,
    *,
    centre: np.ndarray,
    by_wrist: bool,
    crowd: bool,
    end_on: bool,
    rng: np.random.Generator,
) -> list[np.ndarray]:
    """Put the first object at `centre`, the others near it, or in a crowd anywhere in the camera's view.

    Unless `end_on`, no bottle or cylinder points at the lens, where only colours tell it from any disc.

    Returns the poses (4, 4) of those that fit, which stay.
    """
    poses: list[np.ndarray] = []
    for instance in list(objects):
        for _ in range(_TRIES):
            spread = 0.01 if not poses else 0.16
            around = _choose_target(renderer, T_base_camera, rng) if poses and crowd else centre
            if around is None:
                continue
            xy = around[:2] + rng.normal(0.0, 0.01 if crowd else spread, 2)
            above = rng.uniform(0.01, 0.15) if rng.random() < 0.08 else 0.0  # lifted, or falling
            pose = _pose_on_table(instance, xy, _random_lean(rng), above)
            if not end_on and _is_end_on(instance, pose, T_base_camera[:3, 3]):
                continue
            if _fits(renderer, instance, pose, others=poses, T_base_camera=T_base_camera, by_wrist=by_wrist):
                renderer.put(instance, pose)
                poses.append(pose)
                break
        else:
            objects.remove(instance)
    return poses


def _fits(
    renderer: SceneRenderer,
    instance: PropInstance,
    pose: np.ndarray,
    *,
    others: list[np.ndarray],
    T_base_camera: np.ndarray,
    by_wrist: bool,
) -> bool:
    """True when the object is on the table, clear of lens, gripper and the other objects' middles."""
    # The table ends at x = −0.30 m and 1.00 m, and at y = ±0.60 m
    if not (-0.25 < pose[0, 3] < 0.97 and abs(pose[1, 3]) < 0.57):
        return False
    if any(np.linalg.norm(pose[:3, 3] - other[:3, 3]) < 0.085 for other in others):
        return False
    corners = np.vstack(instance.prop.corners())
    depths = (corners @ pose[:3, :3].T + pose[:3, 3] - T_base_camera[:3, 3]) @ T_base_camera[:3, 2]
    if depths.min() < NEAREST_M:
        return False
    if not by_wrist:
        return True
    flange = renderer.data.body("link06")
    points = np.array(_JAW_POINTS) @ flange.xmat.reshape(3, 3).T + flange.xpos
    inside = (points - pose[:3, 3]) @ pose[:3, :3]
    low, high = corners.min(axis=0) - 0.012, corners.max(axis=0) + 0.012
    return not bool(np.all((inside > low) & (inside < high), axis=1).any())


def _is_end_on(instance: PropInstance, pose: np.ndarray, lens: np.ndarray) -> bool:
    ray = pose[:3, 3] - lens
    return instance.prop.kind != "box" and abs(float(ray @ pose[:3, 2])) > _END_ON_COS * float(np.linalg.norm(ray))


def place_distractors(
    renderer: SceneRenderer,
    places: list[np.ndarray],
    T_base_camera: np.ndarray,
    *,
    centre: np.ndarray,
    number: float,
    spread: bool,
    rng: np.random.Generator,
) -> None:
    """Put distractors, `number` in the mean, apart from the objects at `places` and from the lens.

    Their places are around `centre` (3,), or, if `spread`, anywhere in the camera's view.
    """
    others = renderer.distractors()
    for instance in (others[k] for k in rng.permutation(len(others))[: rng.poisson(number)]):
        for _ in range(_TRIES):
            around = _choose_target(renderer, T_base_camera, rng) if spread else centre
            if around is None:
                continue
            xy = around[:2] + rng.normal(0.0, 0.05 if spread else 0.18, 2)
            pose = _pose_on_table(instance, xy, _random_lean(rng))
            apart = all(np.linalg.norm(pose[:2, 3] - place[:2, 3]) > 0.09 for place in places)
            if apart and np.linalg.norm(pose[:3, 3] - T_base_camera[:3, 3]) > 0.16 and abs(pose[1, 3]) < 0.57:
                renderer.put(instance, pose)
                break


def place_occluder(
    renderer: SceneRenderer, T_base_object: np.ndarray, T_base_camera: np.ndarray, rng: np.random.Generator
) -> None:
    """Put a distractor near the line from the lens to the object."""
    instance = renderer.distractors()[rng.integers(len(renderer.distractors()))]
    way = T_base_object[:3, 3] - T_base_camera[:3, 3]
    far = float(np.linalg.norm(way))
    if far < 0.25:
        return
    offset = T_base_camera[:3, :2] @ rng.normal(0.0, 0.035, 2)
    pose = np.eye(4)
    pose[:3, :3] = _random_lean(rng)
    pose[:3, 3] = T_base_camera[:3, 3] + way * (1.0 - rng.uniform(0.09, 0.13) / far) + offset
    if np.linalg.norm(pose[:3, 3] - T_base_camera[:3, 3]) > 0.14:
        renderer.put(instance, pose)
