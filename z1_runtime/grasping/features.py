"""Features of a grasp before it is tried: the same numbers for a fitted head at work and for its training."""

from __future__ import annotations

import numpy as np

from hal.base.transforms import transform_points
from models.obb.mvbb import fit_obb, nearest_faces
from models.obb.obb import OrientedBox
from models.types import GraspSet
from z1_runtime.collision.planning_scene import PlanningScene
from z1_runtime.grasping.grasp_candidates import GraspCandidates
from z1_runtime.types import Observation

FEATURES = {
    "generator": "the generator's score, in [0, 1]",
    "alignment": "with one of the two faces of the upright box that are nearest to the camera, in [-1, 1]",
    "distance_to_centre_m": "from the contacts' midpoint to the object's centre [m]",
    "above_m": "height of the contacts' midpoint over the object's centre [m]",
    "support": "ratio of the pads that the object fills, in [0, 1]",
    "level": "1 where the jaws' push is level, 0 where friction just holds",
    "width_m": "of the object between the jaws [m]",
    "down": "downward part of the approach, sine of its angle, in [-1, 1]",
    "outward": "part of the approach that points out from the arm's base, cosine of the angle, in [-1, 1]",
    "reach_m": "of the contacts' midpoint from the base's axis [m]",
    "height_m": "of the contacts' midpoint over the table [m]",
}
"""Name to meaning, in the order of the columns that `measure_features` returns."""

FORMER_NAMES = {"away_m": "distance_to_centre_m"}
"""Names of features in scoring files and episode tables of version 0.1, and their names here."""

_N_FACES = 2  # whatever a ranking's own k, so that a head means the same under each
_TOP_PERCENTILE = 99.0  # of the heights: single points above the object do not count


def fit_upright_box(observation: Observation) -> OrientedBox:
    """Return the object's upright box in the camera frame.

    Raises:
        DegenerateCloudError: the object's cloud spans no box.
    """
    return fit_obb(observation.object_points, "upright", up=observation.T_base_camera[2, :3])


def box_alignment(grasps: GraspSet, box: OrientedBox) -> np.ndarray:
    """Return the alignment (N,) of each of `grasps` with a near face of `box`, in [-1, 1]; both in the camera frame."""
    normals = box.face_normals[nearest_faces(box, _N_FACES)]
    return np.max(-grasps.T_camera_grasps[:, :3, 2] @ normals.T, axis=1)


def object_centre_from_table(box: OrientedBox, scene: PlanningScene) -> np.ndarray:
    """Return the object's centre (3,) in the base frame: that of `box`, at half the object's height over the table.

    Of an object that leans towards the camera only the top is observed, which puts the box's own centre too high.
    """
    centre = transform_points(scene.T_base_camera, box.T_camera_box[:3, 3])
    top_m = float(np.percentile(scene.table.height_m(scene.object_points), _TOP_PERCENTILE))
    return centre + (0.5 * top_m - scene.table.height_m(centre)) * scene.table.normal


def measure_features(candidates: GraspCandidates) -> np.ndarray:
    """Return the columns `FEATURES`, (M, 11), of M candidates; one without a point between its pads has no support.

    Raises:
        DegenerateCloudError: the object's cloud spans no box.
    """
    scene, table = candidates.scene, candidates.scene.table
    box = candidates.upright_box or fit_upright_box(scene.observation)
    centre = object_centre_from_table(box, scene)
    support, level = candidates.support, candidates.level  # fit the candidates, which measures their widths
    contacts, approaches = candidates.contacts, candidates.approaches
    reach_m = np.linalg.norm(contacts[:, :2], axis=1)
    outward = np.sum(approaches[:, :2] * contacts[:, :2], axis=1) / np.maximum(reach_m, 1e-6)
    columns = {
        "generator": candidates.grasps.scores,
        "alignment": box_alignment(candidates.grasps, box),
        "distance_to_centre_m": np.linalg.norm(contacts - centre, axis=1),
        "above_m": (contacts - centre) @ table.normal,
        "support": np.nan_to_num(support),
        "level": np.nan_to_num(level),
        "width_m": candidates.widths_m,
        "down": -approaches @ table.normal,
        "outward": outward,
        "reach_m": reach_m,
        "height_m": table.height_m(contacts),
    }
    return np.column_stack([columns[name] for name in FEATURES])
