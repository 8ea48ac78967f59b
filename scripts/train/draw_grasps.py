"""Draw the grasp generator's samples on each object of the twin and some others, for `models/weights/README.md`.

    python -m scripts.train.draw_grasps                 # writes models/weights/pictures/*.png

Each picture shows the generator's cloud and its best grasps, spread over their directions: green where the exact check
passes, red where not. The view is the camera's, turned upright.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import tyro

from hal.base.errors import InvalidValueError
from hal.base.transforms import inverse, transform_points
from models.diffusion.sampler import DiffusionConfig, DiffusionSampler
from models.diffusion.training.grippers import GRIPPERS, ParallelGripperSpec
from models.diffusion.training.labels import check_grasps
from models.diffusion.training.shapes import make_shape
from models.diffusion.training.solids import BOX, LATHE, Solid, make_part, make_solid
from models.diffusion.training.views import ViewConfig, render_view
from models.types import GraspSet
from models.weights_file import WEIGHTS_FOLDER
from sim_twin.model.objects import OBJECTS, PAPER_OBJECTS

_SIZE_PX = 360
_PAPER, _CLOUD = (255, 255, 255), (150, 150, 150)
_VALID, _INVALID = (80, 150, 40), (60, 60, 220)  # blue, green, red: OpenCV's order
_VIEW = ViewConfig(
    distance_m=(0.4, 0.4),
    frontal_ratio=1.0,
    frontal_elevation_deg=(12.0, 12.0),
    upright_ratio=1.0,
    one_face_ratio=0.0,
    occluded_view_ratio=0.0,
)


@dataclass(frozen=True, kw_only=True)
class Config:
    """Contents of the pictures, and their folder."""

    out: Path = WEIGHTS_FOLDER / "pictures"
    """Folder for the pictures."""
    grasps: int = 25
    """Grasps in each picture."""
    seed: int = 5
    """Of views and samples."""
    diffusion: DiffusionConfig = field(default_factory=DiffusionConfig)


def main(config: Config) -> None:
    """Write one picture for each object."""
    gripper = GRIPPERS[config.diffusion.gripper]
    if not isinstance(gripper, ParallelGripperSpec):
        raise InvalidValueError(f"Only parallel grippers are drawn; {gripper.name!r} is none.")
    sampler = DiffusionSampler(config.diffusion)
    config.out.mkdir(parents=True, exist_ok=True)
    for name, solid in make_objects().items():
        view = None
        rng = np.random.default_rng(config.seed)
        while view is None:
            view = render_view(solid, _VIEW, rng)  # None with too few visible points
        points, T_camera_object = view
        grasps = sampler.sample(points, 800, config.seed)  # as many as in the benchmark
        grasps = grasps[spread_over_directions(grasps, config.grasps)]
        T_object_grasps = inverse(T_camera_object) @ grasps.T_camera_grasps
        valid = check_grasps(solid, T_object_grasps, gripper, grasps.widths_m).valid
        picture = draw(points, grasps, valid, gripper, T_camera_object)
        cv2.imwrite(str(config.out / f"{name}.png"), picture)


def make_objects() -> dict[str, Solid]:
    """Return the paper's objects, and some of other families."""
    rng = np.random.default_rng(7)
    others = ("cup", "l_shape", "mug", "hammer", "goblet")
    return {name: _as_solid(name) for name in PAPER_OBJECTS} | {name: make_shape(name, rng) for name in others}


def _as_solid(name: str) -> Solid:
    """Return one of the paper's objects as a solid."""
    parts = []
    for part in OBJECTS[name].parts:
        if part.kind == "box":
            parts.append(make_part(BOX, part.size_m, origin=(0.0, 0.0, part.z_m)))
            continue
        low, high, half = (part.size_m[0], *part.size_m) if part.kind == "cylinder" else part.size_m
        z = (part.z_m - half, part.z_m + half)
        parts.append(make_part(LATHE, profile=[(0.0, z[0]), (low, z[0]), (high, z[1]), (0.0, z[1])]))
    return make_solid(name, parts)


def spread_over_directions(grasps: GraspSet, count: int) -> np.ndarray:
    """Return indices (count,) of grasps, each the maximum of score times distance to all approaches chosen so far."""
    approach, scores = grasps.T_camera_grasps[:, :3, 2], grasps.scores
    chosen = [0]
    distance = np.full(len(grasps), 2.0)  # the maximum between unit vectors
    while len(chosen) < min(count, len(grasps)):
        distance = np.minimum(distance, np.linalg.norm(approach - approach[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance * scores)))
    return np.array(chosen)


def draw(
    points: np.ndarray, grasps: GraspSet, valid: np.ndarray, gripper: ParallelGripperSpec, T_camera_object: np.ndarray
) -> np.ndarray:
    """Return an upright picture (360, 360, 3) of the cloud and the grippers around it."""
    middle = points.mean(axis=0)
    R = _upright(T_camera_object, middle)
    poses = list(zip(grasps.T_camera_grasps, grasps.widths_m, strict=True))
    strokes = [(R @ (s - middle).T).T for s in np.concatenate([_gripper_lines(T, w, gripper) for T, w in poses])]
    cloud = (points - middle) @ R.T
    scale = 0.47 * _SIZE_PX / max(np.abs(np.concatenate(strokes)[:, :2]).max(), 0.05)

    def pixel(p: np.ndarray) -> tuple[int, int]:
        return round(_SIZE_PX / 2 + scale * p[0]), round(_SIZE_PX / 2 + scale * p[1])

    picture = np.full((_SIZE_PX, _SIZE_PX, 3), _PAPER, np.uint8)
    colours = [_VALID if good else _INVALID for good in np.repeat(valid, len(strokes) // len(grasps))]
    depth = np.array([s[:, 2].mean() for s in strokes])
    behind = depth > np.median(cloud[:, 2])
    for far in (True, False):  # lines behind the cloud are drawn before it
        for k in np.argsort(-depth):
            if behind[k] == far:
                cv2.line(picture, pixel(strokes[k][0]), pixel(strokes[k][1]), colours[k], 1, cv2.LINE_AA)
        if far:
            for p in cloud[np.argsort(-cloud[:, 2])]:
                cv2.circle(picture, pixel(p), 1, _CLOUD, cv2.FILLED, cv2.LINE_AA)
    text = f"{int(valid.sum())} of {len(valid)} hold"
    cv2.putText(picture, text, (8, _SIZE_PX - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (90, 90, 90), 1, cv2.LINE_AA)
    return picture


def _gripper_lines(T: np.ndarray, width_m: float, gripper: ParallelGripperSpec) -> np.ndarray:
    """Return strokes (4, 2, 3): two fingers a centimetre off the contacts, the bar between, the wrist."""
    half = min(width_m / 2.0 + 0.01, gripper.max_width_m / 2.0)
    back = -0.6 * gripper.finger_length_m
    corners = np.array(
        [(0, -half, 0), (0, -half, back), (0, half, back), (0, half, 0), (0, 0, back), (0, 0, 1.6 * back)]
    )
    return transform_points(T, corners)[[[0, 1], [1, 2], [2, 3], [4, 5]]]


def _upright(T_camera_object: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) into a picture along the view ray with the object's up."""
    z = middle / np.linalg.norm(middle)
    up = T_camera_object[:3, 2]
    y = -(up - (up @ z) * z)
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z])


if __name__ == "__main__":
    main(tyro.cli(Config))
