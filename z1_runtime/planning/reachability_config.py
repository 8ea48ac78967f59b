"""Weights that rank grasps for this arm and gripper."""

from __future__ import annotations

from dataclasses import dataclass

from hal.base.errors import InvalidValueError


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
