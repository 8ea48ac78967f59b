"""Single depth views of a solid, with the errors of a short-range stereo camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import zoom
from scipy.spatial.transform import Rotation

from models.diffusion.training.solids import Solid

_COARSE, _FINE = 36, 52  # rays along each side of the picture: to find the object, then to render it
_MIN_POINTS = 150


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewConfig:
    """Distributions of object poses, viewpoints and depth errors."""

    distance_m: tuple[float, float] = (0.2, 0.6)
    """Range of the camera's distance [m]."""
    frontal_ratio: float = 0.6
    """Ratio of views from the front."""
    frontal_elevation_deg: tuple[float, float] = (-5.0, 30.0)
    """Range of the frontal views' elevation."""
    other_elevation_deg: tuple[float, float] = (-20.0, 85.0)
    """Range of all other views' elevation."""
    upright_ratio: float = 0.55
    """Ratio of upright objects; of the rest half are tilted by up to 40°, half have a random orientation."""
    one_face_ratio: float = 0.2
    """Ratio of views square to an object's x or y side."""
    occluded_view_ratio: float = 0.4
    """Ratio of views with an occluded part."""
    occluded_point_ratio: tuple[float, float] = (0.1, 0.45)
    """Range of the ratio of occluded points in those."""
    noise_per_m: tuple[float, float] = (0.002, 0.010)
    """Range of the depth noise's standard deviation over the squared distance [1/m]; 0.2 to 0.9 mm at 0.3 m."""
    flying_point_ratio: float = 0.01
    """Ratio of points shifted back along their ray."""


def render_view(solid: Solid, config: ViewConfig, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray] | None:
    """Return visible points (N, 3) in the camera frame and T_camera_object (4, 4); None with too few points."""
    T_camera_object = _draw_pose(config, rng)
    rays, reach = _render_depth(solid, T_camera_object)
    hit = np.isfinite(reach)
    if hit.sum() < _MIN_POINTS:
        return None
    reach = reach + _depth_error(reach, hit, rng.uniform(*config.noise_per_m), rng)
    visible = _drop_grazing(solid, T_camera_object, rays, reach, hit=hit, rng=rng)
    points = (rays * reach[..., None])[visible]
    flying = rng.random(len(points)) < config.flying_point_ratio
    points[flying] *= 1.0 + rng.exponential(0.01, (flying.sum(), 1)) / np.linalg.norm(points[flying], axis=1)[:, None]
    if rng.random() < config.occluded_view_ratio:
        points = _occlude_part(points, rng.uniform(*config.occluded_point_ratio), rng)
    return (points, T_camera_object) if len(points) >= _MIN_POINTS else None


def _draw_pose(config: ViewConfig, rng: np.random.Generator) -> np.ndarray:
    kind = rng.random()
    turn = Rotation.identity()
    if kind > config.upright_ratio:
        tilted = kind < (1.0 + config.upright_ratio) / 2.0
        axis = np.append(rng.normal(size=2), 0.0)
        tilt = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(rng.uniform(5.0, 40.0)))
        turn = tilt if tilted else Rotation.from_quat(rng.normal(size=4))
    one_face = rng.random() < config.one_face_ratio
    azimuth = rng.integers(4) * np.pi / 2 + rng.normal(0.0, 0.04) if one_face else rng.uniform(0.0, 2 * np.pi)
    frontal = rng.random() < config.frontal_ratio
    elevation = np.radians(rng.uniform(*(config.frontal_elevation_deg if frontal else config.other_elevation_deg)))
    # Camera looking along +x of a level frame: image x = −y, image y = −z; then raised, turned and rolled.
    level = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    roll = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
    R = roll.as_matrix() @ level @ Rotation.from_euler("zy", [azimuth, -elevation]).as_matrix() @ turn.as_matrix()
    T = np.eye(4)
    T[:3, :3] = R
    direction = np.array([rng.normal(0.0, 0.12), rng.normal(0.0, 0.12), 1.0])
    T[:3, 3] = rng.uniform(*config.distance_m) * direction / np.linalg.norm(direction)
    return T


def _render_depth(solid: Solid, T_camera_object: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit rays (52, 52, 3) over the object's outline and their lengths (52, 52) to it [m]."""
    center, radius = T_camera_object[:3, 3], solid.enclosing_radius()
    middle = center[:2] / center[2]
    half = 1.1 * radius / center[2]
    window = (middle[0] - half, middle[0] + half, middle[1] - half, middle[1] + half)
    for count in (_COARSE, _FINE):
        u, v = np.linspace(*window[:2], count), np.linspace(*window[2:], count)
        rays = np.stack([*np.meshgrid(u, v), np.ones((count, count))], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        reach = _cast(solid, T_camera_object, rays.reshape(-1, 3)).reshape(count, count)
        rows, columns = np.nonzero(np.isfinite(reach))
        if len(rows) == 0 or count == _FINE:
            break
        step = u[1] - u[0]
        # A coarse ray wider: the outline is between the last ray that hits and the next
        window = (u[columns.min()] - step, u[columns.max()] + step, v[rows.min()] - step, v[rows.max()] + step)
    return rays, reach


def _cast(solid: Solid, T_camera_object: np.ndarray, rays: np.ndarray) -> np.ndarray:
    R, t = T_camera_object[:3, :3], T_camera_object[:3, 3]
    origins = np.broadcast_to(-t @ R, rays.shape)
    return solid.cast(origins, rays @ R, float(np.linalg.norm(t)) + 0.3)


def _depth_error(reach: np.ndarray, hit: np.ndarray, noise_per_m: float, rng: np.random.Generator) -> np.ndarray:
    """Return errors like `reach` [m]: half of the spread from pixel to pixel, half in patches, growing with z²."""
    patches = np.asarray(zoom(rng.normal(size=(10, 10)), np.array(reach.shape) / 10.0, order=1))
    mixed = 0.75 * rng.normal(size=reach.shape) + 0.75 * patches
    return noise_per_m * np.where(hit, reach, 0.0) ** 2 * mixed


def _drop_grazing(
    solid: Solid, T_camera_object: np.ndarray, rays: np.ndarray, reach: np.ndarray, *, hit: np.ndarray, rng
) -> np.ndarray:
    """Return the mask (52, 52) of the points that remain: surfaces at a grazing angle often get no depth."""
    R, t = T_camera_object[:3, :3], T_camera_object[:3, 3]
    points = (rays[hit] * reach[hit, None] - t) @ R
    facing = np.abs(np.sum(solid.normals(points) * (rays[hit] @ R), axis=1))
    visible = hit.copy()
    visible[hit] = rng.random(len(points)) < np.clip(facing / 0.3, 0.05, 1.0)
    return visible


def _occlude_part(points: np.ndarray, ratio: float, rng: np.random.Generator) -> np.ndarray:
    """Return `points` without the `ratio` of them furthest to one side of the picture."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    side = points[:, :2] @ np.array([np.cos(angle), np.sin(angle)])
    return points[side <= np.quantile(side, 1.0 - ratio)]
