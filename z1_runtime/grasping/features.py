"""What is measured of a grasp before it is tried: the same numbers for a fitted head at work and for its training."""

from __future__ import annotations

import numpy as np

from models.obb.mvbb import fit_obb, nearest_faces
from models.types import GraspSet
from z1_runtime.grasping.grasp_candidates import GraspCandidates
from z1_runtime.types import Observation, Plane

FEATURES = {
    "generator": "the generator's score, in [0, 1]",
    "alignment": "with one of the two faces of the upright box that are nearest to the camera, in [-1, 1]",
    "away_m": "from the contacts' middle to the object's [m]",
    "above_m": "height of the contacts' middle over the object's [m]",
    "support": "share of the pads that the object fills, in [0, 1]",
    "level": "1 where the jaws' push is level, 0 where friction just holds",
    "width_m": "of the object between the jaws [m]",
    "down": "how far the approach points down, sine of the angle, in [-1, 1]",
    "outward": "how far it points away from the arm's base, cosine of the angle, in [-1, 1]",
    "reach_m": "of the contacts' middle from the base's axis [m]",
    "height_m": "of the contacts' middle over the table [m]",
}
"""Name to meaning, in the order of the columns that `measure` returns."""

_FACES = 2  # whatever a ranking's own k, so that a head means the same under each


def seen_by_box(grasps: GraspSet, observation: Observation) -> tuple[np.ndarray, np.ndarray]:
    """Return how well each of `grasps` comes at a near face of the upright box, (N,), and the middle (3,) of that box.

    All is in the camera frame; the alignments are in [-1, 1].

    Raises:
        DegenerateCloudError: the object's cloud spans no box.
    """
    box = fit_obb(observation.object_points, "upright", up=observation.T_base_camera[2, :3])
    normals = box.face_normals[nearest_faces(box, _FACES)]
    return np.max(-grasps.T_camera_grasps[:, :3, 2] @ normals.T, axis=1), box.T_camera_box[:3, 3]


def measure(
    candidates: GraspCandidates,
    *,
    approaches: np.ndarray,
    middle: np.ndarray,
    table: Plane,
    alignments: np.ndarray,
    generator: np.ndarray,
) -> np.ndarray:
    """Return what `FEATURES` name, (N, 11), of N candidates; one that met no point of the object has zero support.

    Args:
        candidates: each laid out for the beak (asked for its `ways`).
        approaches: (N, 3) unit vectors, base frame.
        middle: (3,) of the object, base frame [m].
        table: base frame.
        alignments: (N,) as `seen_by_box` returns them.
        generator: (N,) scores.
    """
    contacts = candidates.contacts
    reach_m = np.linalg.norm(contacts[:, :2], axis=1)
    outward = np.sum(approaches[:, :2] * contacts[:, :2], axis=1) / np.maximum(reach_m, 1e-6)
    columns = {
        "generator": generator,
        "alignment": alignments,
        "away_m": np.linalg.norm(contacts - middle, axis=1),
        "above_m": (contacts - middle) @ table.normal,
        "support": np.nan_to_num(candidates.support),
        "level": np.nan_to_num(candidates.level),
        "width_m": candidates.widths_m,
        "down": -approaches @ table.normal,
        "outward": outward,
        "reach_m": reach_m,
        "height_m": table.height_m(contacts),
    }
    return np.column_stack([columns[name] for name in FEATURES])
