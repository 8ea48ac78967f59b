"""Sampled places of neighbours: left and right of the object and behind it, with room for the gripper between."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim_twin.model.objects import OBJECTS
from sim_twin.model.scene import Neighbour, SceneConfig

MAX_NEIGHBOURS = 3
"""Maximum number of neighbours of an object."""
GAP_M = (0.070, 0.130)
"""Free table between the object's outermost point and a neighbour's [m]: the gripper fits, and may still collide."""
_BETWEEN_M = 0.020
_BEARING_DEG = 115.0
"""From straight behind the object to either side; in front of it a neighbour would occlude it."""
_X_M, _Y_M = (0.36, 0.85), (-0.45, 0.45)
_TRIES = 2000


def draw_neighbours(scene: SceneConfig, count: int, names: Sequence[str], seed: int) -> tuple[Neighbour, ...]:
    """Return `count` neighbours of the object of `scene`, all different while `names` suffice.

    Args:
        scene: with the object in its place.
        count: how many.
        names: the objects to draw from.
        seed: the same one gives the same neighbours.

    Raises:
        RuntimeError: no place was found.
    """
    # A stream of its own: the camera's noise has the bare seed
    rng = np.random.default_rng([seed, 0xC1])
    order = [names[int(k) % len(names)] for k in rng.permutation(max(count, len(names)))]
    pose = scene.T_base_object()
    middle, radius_m = pose[:2, 3], _radius_m(scene.grasp_object.corners() @ pose[:3, :3].T)
    placed: list[tuple[np.ndarray, float]] = []
    neighbours = []
    for name in order[:count]:
        own_m = _radius_m(OBJECTS[name].corners())
        where = _place(rng, middle, radius_m + own_m, own_m, placed)
        placed.append((where, own_m))
        x_m, y_m = (float(value) for value in where)
        neighbours.append(Neighbour(object=name, x_m=x_m, y_m=y_m, yaw_deg=float(rng.uniform(-180.0, 180.0))))
    return tuple(neighbours)


def _place(
    rng: np.random.Generator,
    middle: np.ndarray,
    touching_m: float,
    own_m: float,
    placed: Sequence[tuple[np.ndarray, float]],
) -> np.ndarray:
    """Return the place (2,) of the next neighbour: `touching_m` and a gap from the object, clear of the others."""
    behind = np.arctan2(middle[1], middle[0])
    for _ in range(_TRIES):
        bearing = behind + np.deg2rad(rng.uniform(-_BEARING_DEG, _BEARING_DEG))
        where = middle + (touching_m + rng.uniform(*GAP_M)) * np.array([np.cos(bearing), np.sin(bearing)])
        on_table = _X_M[0] <= where[0] <= _X_M[1] and _Y_M[0] <= where[1] <= _Y_M[1]
        if on_table and all(np.linalg.norm(where - p) > own_m + r + _BETWEEN_M for p, r in placed):
            return where
    raise RuntimeError(
        f"clutter: no place for another neighbour ({len(placed)} placed, {_TRIES} tries). Ask for fewer neighbours."
    )


def _radius_m(corners: np.ndarray) -> float:
    """Return the radius of `corners` (N, 3) about the origin in the table's plane [m]."""
    return float(np.hypot(corners[:, 0], corners[:, 1]).max())
