"""Distances of the collision checks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.base import z1
from hal.base.errors import InvalidValueError
from z1_runtime.collision.voxel_grid import MAX_THRESHOLD_M


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionConfig:
    """Distances below which two things count as colliding."""

    scene_threshold_m: float = 0.002
    """Minimum distance of scene points from the gripper's surface, the paper's 2 mm [m]."""
    object_threshold_m: float = 0.0035
    """The same for the object's own points while the opened jaws go around it; perception trims about 1 mm off its
    edges and the arm tracks within 2 mm [m]."""
    transfer_threshold_m: float = 0.005
    """The same for scene and object during the transfer to the pre-grasp [m]."""
    table_margin_m: float = 0.004
    """Minimum height of the gripper over the table [m]."""
    closing_margin_m: float = 0.002
    """The same while the jaws close and the gripper turns with them: the plane's uncertainty, as the HAL's guard
    rejects what goes below its own [m]."""
    link_margin_m: float = 0.010
    """Minimum height of the arm's links over the table [m]."""
    table_noise_m: float = 0.007
    """Scene points lower than this over the table are its noise; the plane represents them [m]."""
    object_halo_m: float = 0.006
    """Scene points nearer than this to the object are its own border [m]."""
    robot_halo_m: float = 0.010
    """Scene points nearer than this to gripper and camera, as posed in the frame, are the robot's own [m]."""
    cut_off_m: float = 0.015
    """An object whose lowest observed points are higher than this over the table continues down to it [m]."""
    sample_s: float = 0.016
    """Time between two checked samples of a trajectory [s]."""

    def __post_init__(self) -> None:
        thresholds = ("scene_threshold_m", "object_threshold_m", "transfer_threshold_m")
        for name in (*thresholds, "object_halo_m", "robot_halo_m"):
            if not 0.0 <= getattr(self, name) <= MAX_THRESHOLD_M:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; allowed is 0 to {MAX_THRESHOLD_M} m.")
        for name in ("table_margin_m", "closing_margin_m", "link_margin_m", "table_noise_m", "cut_off_m"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be finite and not negative.")
        if not z1.CONTROL_PERIOD_S <= self.sample_s <= 0.05:
            raise InvalidValueError(f"sample_s is {self.sample_s}; allowed is {z1.CONTROL_PERIOD_S} to 0.05 s.")
