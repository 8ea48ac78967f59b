"""One exact image of the wrist camera, and the interface of the renderers that make it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np

from sim_twin.model.objects import OBJECT_BODY


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """One exact image."""

    colour: np.ndarray
    """(H, W, 3) uint8, RGB."""
    z_m: np.ndarray
    """(H, W) float32 distance along the optical axis [m]; 0 where nothing is hit."""
    mask: np.ndarray
    """(H, W) bool, the object's pixels."""


class WristRenderer(Protocol):
    """Draws for the wrist camera; belongs to the thread that made it."""

    def render(self, data: mujoco.MjData) -> View:
        """Draw the state `data` (kinematics computed)."""
        ...

    def close(self) -> None:
        """Free what the renderer holds."""
        ...


def camera_id(model: mujoco.MjModel) -> int:
    """Return the number of the wrist camera."""
    return model.camera("wrist").id


def object_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Return which geoms (ngeom,) bool are the object's."""
    return model.geom_bodyid == model.body(OBJECT_BODY).id
