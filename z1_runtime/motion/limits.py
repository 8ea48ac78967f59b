"""Limits of motions: speeds in joints and along straight lines, and the joints' own range."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from hal.base import z1
from hal.base.errors import InvalidValueError

DEFAULT_SPEED = 0.5
"""Fraction of the arm's limits that a motion uses by default."""

LIMIT_TOLERANCE_RAD = 0.005
"""A measured joint at rest at its limit, or a planned one, may be this far beyond it [rad]."""

# At full speed; the Z1's data sheet has no Cartesian figures, these are ours
_FULL_LINEAR = (0.5, 2.0, 20.0)
_FULL_ANGULAR = (2.0, 8.0, 80.0)


def _scaled(limit: np.ndarray) -> Callable[[], np.ndarray]:
    return lambda: DEFAULT_SPEED * limit


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionLimits:
    """Limits of a motion; `MotionLimits()` is half of the arm's own, see `at_speed`.

    Raises:
        ValueError: a limit is not positive, not finite, or above `hal.base.z1`'s.
    """

    velocity: np.ndarray = field(default_factory=_scaled(z1.DQ_MAX))
    """(7,) joint speed [rad/s]."""
    acceleration: np.ndarray = field(default_factory=_scaled(z1.DDQ_MAX))
    """(7,) joint acceleration [rad/s²]."""
    jerk: np.ndarray = field(default_factory=_scaled(z1.DDDQ_MAX))
    """(7,) joint jerk [rad/s³]."""
    linear_velocity: float = DEFAULT_SPEED * _FULL_LINEAR[0]
    """Speed of the pivot on straight motions [m/s]."""
    linear_acceleration: float = DEFAULT_SPEED * _FULL_LINEAR[1]
    """[m/s²]"""
    linear_jerk: float = DEFAULT_SPEED * _FULL_LINEAR[2]
    """[m/s³]"""
    angular_velocity: float = DEFAULT_SPEED * _FULL_ANGULAR[0]
    """Turning speed of the pivot on straight motions [rad/s]."""
    angular_acceleration: float = DEFAULT_SPEED * _FULL_ANGULAR[1]
    """[rad/s²]"""
    angular_jerk: float = DEFAULT_SPEED * _FULL_ANGULAR[2]
    """[rad/s³]"""

    def __post_init__(self) -> None:
        ceilings = {"velocity": z1.DQ_MAX, "acceleration": z1.DDQ_MAX, "jerk": z1.DDDQ_MAX}
        for name, ceiling in ceilings.items():
            limit = np.array(getattr(self, name), dtype=np.float64)
            # The factor admits the rounding of a scaled limit
            if limit.shape != (z1.N_JOINTS,) or not ((limit > 0.0) & (limit <= ceiling * (1 + 1e-9))).all():
                raise InvalidValueError(f"{name} is {limit}; allowed is (7,), above 0 and up to {ceiling}.")
            limit.setflags(write=False)
            object.__setattr__(self, name, limit)
        for kind in ("linear", "angular"):
            for name in (f"{kind}_velocity", f"{kind}_acceleration", f"{kind}_jerk"):
                if not 0.0 < getattr(self, name) < np.inf:
                    raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be positive and finite.")

    def scaled(self, factor: float) -> MotionLimits:
        """Return limits `factor` times as high, but at most the arm's own.

        Raises:
            ValueError: `factor` is not positive and finite.
        """
        if not 0.0 < factor < np.inf:
            raise InvalidValueError(f"factor is {factor}; it must be positive and finite.")
        changes: dict[str, np.ndarray | float] = {}
        names, joints = ("velocity", "acceleration", "jerk"), (z1.DQ_MAX, z1.DDQ_MAX, z1.DDDQ_MAX)
        for name, joint, linear, angular in zip(names, joints, _FULL_LINEAR, _FULL_ANGULAR, strict=True):
            changes[name] = np.minimum(factor * getattr(self, name), joint)
            changes[f"linear_{name}"] = min(factor * getattr(self, f"linear_{name}"), linear)
            changes[f"angular_{name}"] = min(factor * getattr(self, f"angular_{name}"), angular)
        return replace(self, **changes)  # pyright: ignore[reportArgumentType]

    @classmethod
    def at_speed(cls, speed: float) -> MotionLimits:
        """Return all limits at fraction `speed` in (0, 1] of the arm's full ones.

        Raises:
            ValueError: `speed` is outside (0, 1].
        """
        if not 0.0 < speed <= 1.0:
            raise InvalidValueError(f"speed is {speed}; allowed is above 0 and up to 1.")
        linear, angular = speed * np.array(_FULL_LINEAR), speed * np.array(_FULL_ANGULAR)
        return cls(
            velocity=speed * z1.DQ_MAX,
            acceleration=speed * z1.DDQ_MAX,
            jerk=speed * z1.DDDQ_MAX,
            linear_velocity=float(linear[0]),
            linear_acceleration=float(linear[1]),
            linear_jerk=float(linear[2]),
            angular_velocity=float(angular[0]),
            angular_acceleration=float(angular[1]),
            angular_jerk=float(angular[2]),
        )


def clip_joints(q: np.ndarray, name: str) -> np.ndarray:
    """Return `q` (7,) inside the joint limits, where it is at most `LIMIT_TOLERANCE_RAD` beyond them.

    Raises:
        ValueError: it is further beyond, not finite, or no joint vector; the message calls it `name`.
    """
    q = np.array(q, dtype=np.float64)
    if q.shape != (z1.N_JOINTS,):
        raise InvalidValueError(f"{name} has shape {q.shape}; a joint vector is ({z1.N_JOINTS},).", code="shape")
    for joint, value, low, high in zip(z1.JOINT_NAMES, q, z1.Q_MIN, z1.Q_MAX, strict=True):
        if not low - LIMIT_TOLERANCE_RAD <= value <= high + LIMIT_TOLERANCE_RAD:
            message = f"{name}: {joint} is {value:.4f} rad; allowed is {low:.4f} to {high:.4f} rad."
            raise InvalidValueError(message, code="joint_limit")
    return np.clip(q, z1.Q_MIN, z1.Q_MAX)
