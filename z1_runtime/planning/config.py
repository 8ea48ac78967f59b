"""Settings of the planner and of the ranking by reach."""

from __future__ import annotations

from dataclasses import dataclass, field

from hal.base.errors import InvalidValueError
from z1_runtime.collision.planning_scene import CollisionConfig
from z1_runtime.geometry.gripper_geometry import GripperPlacementConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class ReachabilityConfig:
    """Weights of the ranking, and the number of grasps checked for inverse kinematics."""

    centring: float = 0.30
    """Near the object's centre: an object held there does not turn in the jaws."""
    support: float = 0.25
    """The object fills the pads."""
    level: float = 0.10
    """The jaws' push is level, so that friction need not hold a wedge."""
    generator: float = 0.15
    """The generator's score."""
    box: float = 0.10
    """Alignment with a face of the object's box."""
    manipulability: float = 0.10
    """Far from joint limits and singular postures."""
    centring_m: float = 0.035
    """Distance from the centre at which the term has fallen to 0.6 [m]."""
    n_reached: int = 16
    """Grasps found within reach before the others keep their place."""
    n_asked: int = 120
    """Maximum number of grasps whose joints are solved."""

    def __post_init__(self) -> None:
        weights = (self.centring, self.support, self.level, self.generator, self.box, self.manipulability)
        if min(weights) < 0.0 or not abs(sum(weights) - 1.0) < 1e-6:
            raise InvalidValueError(
                f"ReachabilityConfig: the weights are {weights}; none may be negative, their sum must be 1."
            )
        if not self.centring_m > 0.0 or not 1 <= self.n_reached <= self.n_asked:
            raise InvalidValueError(
                "ReachabilityConfig: centring_m > 0 and 1 <= n_reached <= n_asked are required; got "
                f"{self.centring_m}, {self.n_reached} and {self.n_asked}."
            )


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
