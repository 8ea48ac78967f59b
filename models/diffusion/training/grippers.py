"""Grippers that weights can be trained for, as data: sizes, openings and friction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hal.base.errors import InvalidValueError
from models.diffusion.network import MAX_WIDTHS_M
from models.diffusion.training.z1_gripper import Z1GripperSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class ParallelGripperSpec:
    """Parallel gripper in the grasp frame: z approach, y closing, origin midway between the open fingertips."""

    name: str
    max_width_m: float
    """Opening during the approach [m]."""
    min_width_m: float = 0.004
    """Narrowest object that ground truth closes on [m]."""
    finger_length_m: float = 0.07
    """From the palm to the fingertips [m]."""
    finger_thickness_m: float = 0.012
    """Of one finger, along y [m]."""
    finger_width_m: float = 0.022
    """Of one finger, along x [m]."""
    palm_width_m: float = 0.06
    """Of the palm, along x [m]."""
    palm_length_m: float = 0.08
    """Length of the gripper behind the fingers [m]."""
    min_depth_m: float = 0.004
    """Minimum reach of the fingertips past the contacts in ground truth [m]."""
    max_depth_m: float = 0.02
    """Maximum reach of the fingertips past the contacts in ground truth [m]."""
    friction: float = 0.5
    """Coulomb coefficient that a valid grasp may count on."""
    symmetric: ClassVar[bool] = True
    """Whether the gripper is the same turned over."""

    def __post_init__(self) -> None:
        if not 0.0 < self.min_width_m < self.max_width_m:
            raise InvalidValueError(
                f"gripper {self.name!r}: needs 0 < min_width_m < max_width_m; got {self.min_width_m}, "
                f"{self.max_width_m}.",
                code="gripper_width",
            )
        if not 0.0 <= self.min_depth_m <= self.max_depth_m < self.finger_length_m:
            raise InvalidValueError(
                f"gripper: needs 0 ≤ min_depth_m ≤ max_depth_m < finger_length_m; got {self}.", code="gripper_depth"
            )

    def body_points(self) -> np.ndarray:
        """Return points (K, 3) on the open gripper's fingers and palm, for the collision check."""
        inner, outer = self.max_width_m / 2.0, self.max_width_m / 2.0 + self.finger_thickness_m
        half = self.finger_width_m / 2.0
        z_finger = np.linspace(-self.finger_length_m, 0.0, 11)
        fingers = [_grid([-half, 0.0, half], [s * inner, s * outer], z_finger) for s in (-1.0, 1.0)]
        z_palm = -self.finger_length_m - np.array([0.0, 0.3, 1.0]) * self.palm_length_m
        palm_half = self.palm_width_m / 2.0
        palm = _grid(np.linspace(-palm_half, palm_half, 5), np.linspace(-outer, outer, 17), z_palm)
        return np.concatenate([*fingers, palm])

    def pad_points(self) -> np.ndarray:
        """Return points (K, 2) x, z on a finger's inner face, for its closing."""
        half = 0.8 * self.finger_width_m / 2.0
        grid = _grid([-half, 0.0, half], [0.0], np.linspace(-0.7 * self.finger_length_m, -0.001, 8))
        return np.ascontiguousarray(grid[:, [0, 2]])


AnyGripper = ParallelGripperSpec | Z1GripperSpec
GRIPPERS: dict[str, AnyGripper] = {
    "agnostic": ParallelGripperSpec(name="agnostic", max_width_m=MAX_WIDTHS_M["agnostic"]),
    "z1": Z1GripperSpec(name="z1"),
}
"""Grippers by the name in the weights' recipe; `agnostic` has the opening of a Robotiq 2F-140 (its datasheet)."""


def _grid(x, y, z) -> np.ndarray:
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float64)
