"""Numbers of the planner."""

from __future__ import annotations

from dataclasses import dataclass, field

from hal.base.errors import InvalidValueError
from z1_runtime.collision.collision_config import CollisionConfig
from z1_runtime.geometry.gripper_geometry import GripperPlacementConfig
from z1_runtime.planning.reachability_config import ReachabilityConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannerConfig:
    """Approach and lift of a grasp, and limits of the search."""

    standoff_m: float = 0.09
    """From the pre-grasp to the grasp along the approach [m]."""
    short_standoff_m: float = 0.06
    """Tried where the arm cannot draw back that far [m]."""
    lift_m: float = 0.10
    """Straight up after closing [m]."""
    closing_speed_scale: float = 2.0
    """Speed of closing against the rest of the motion: an object that leans falls while only one jaw touches it."""
    fallback_width_m: float = 0.06
    """Width where neither the generator nor the cloud gives one [m]."""
    max_tried: int = 60
    """Reachable candidates whose motion is planned before giving up; bounds the worst case."""
    max_least_squares: int = 60
    """Poses without joints that are given to least squares once all candidates were rejected, 1 to 3 ms each;
    0 leaves it out."""
    max_branches: int = 2
    """Joint solutions tried per pre-grasp, nearest to home first."""
    raise_m: float = 0.12
    """Height of the detour over the pre-grasp, when the direct transfer is blocked [m]."""
    max_swing_rad: float = 1.2
    """A joint that turns further than this between pre-grasp and grasp, or grasp and lift, has changed its branch."""
    reachability: ReachabilityConfig = field(default_factory=ReachabilityConfig)
    """Weights that rank the grasps for this arm and gripper."""
    gripper: GripperPlacementConfig = field(default_factory=GripperPlacementConfig)
    """Fit of the gripper to an object."""
    collision: CollisionConfig = field(default_factory=CollisionConfig)
    """Distances that count as a collision."""

    def __post_init__(self) -> None:
        if not 0.0 < self.short_standoff_m <= self.standoff_m or self.lift_m <= 0.0 or self.max_tried < 1:
            raise InvalidValueError(
                "PlannerConfig: 0 < short_standoff_m <= standoff_m, lift_m > 0 and max_tried >= 1 are required; got "
                f"{self.short_standoff_m}, {self.standoff_m}, {self.lift_m} and {self.max_tried}."
            )
        if not 1.0 <= self.closing_speed_scale <= 10.0:
            raise InvalidValueError(f"closing_speed_scale is {self.closing_speed_scale}; allowed is 1 to 10.")
        for name in ("max_least_squares", "max_branches", "raise_m", "fallback_width_m"):
            minimum = 1 if name == "max_branches" else 0
            if not minimum <= getattr(self, name) < float("inf"):
                raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be finite and at least {minimum}.")
