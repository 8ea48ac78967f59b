"""What makes one grasp better than another, in numbers."""

from __future__ import annotations

from dataclasses import dataclass

from hal.base.errors import InvalidValueError


@dataclass(frozen=True, slots=True, kw_only=True)
class ReachabilityConfig:
    """What counts for how much, and how many grasps the arm is asked about."""

    centring: float = 0.30
    """Near the object's middle: what is held there does not turn in the hand."""
    support: float = 0.25
    """The object fills the pads."""
    level: float = 0.10
    """The jaws' push is level, so that friction need not make up for a wedge."""
    generator: float = 0.15
    """The generator's score."""
    box: float = 0.10
    """Alignment with a face of the object's box."""
    ease: float = 0.10
    """Away from joint limits and singular postures."""
    centring_m: float = 0.035
    """Distance from the middle at which the term has fallen to 0.6 [m]."""
    n_reached: int = 16
    """Grasps found within reach before the others are left as they are."""
    n_asked: int = 120
    """Most grasps whose joints are asked."""

    def __post_init__(self) -> None:
        weights = (self.centring, self.support, self.level, self.generator, self.box, self.ease)
        if min(weights) < 0.0 or not abs(sum(weights) - 1.0) < 1e-6:
            raise InvalidValueError(
                f"the weights of AbilityConfig are {weights}; none may be negative, their sum must be 1."
            )
        if not self.centring_m > 0.0 or not 1 <= self.n_reached <= self.n_asked:
            raise InvalidValueError(
                "AbilityConfig wants centring_m > 0 and 1 <= n_reached <= n_asked; got "
                f"{self.centring_m}, {self.n_reached} and {self.n_asked}."
            )
