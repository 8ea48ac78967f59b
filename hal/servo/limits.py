"""What the servo lets through to the arm: joint limits, speed, grip torque, and what counts as blocked."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import NamedTuple

import numpy as np

from hal.base import z1
from hal.base.errors import InvalidMessageError
from hal.base.messages import frozen_array

_GRIPPER = z1.N_ARM
_MEASURED = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ServoLimits:
    """Limits of the servo; the defaults are the Z1's (`hal.base.z1`)."""

    q_min: np.ndarray = field(default_factory=lambda: z1.Q_MIN)
    """(7,) lowest joint position [rad]."""
    q_max: np.ndarray = field(default_factory=lambda: z1.Q_MAX)
    """(7,) highest joint position [rad]."""
    dq_max: np.ndarray = field(default_factory=lambda: z1.DQ_MAX)
    """(7,) highest joint speed [rad/s]."""
    ddq_max: np.ndarray = field(default_factory=lambda: z1.DDQ_MAX)
    """(7,) joint acceleration used for braking and blending [rad/s²]."""
    dddq_max: np.ndarray = field(default_factory=lambda: z1.DDDQ_MAX)
    """(7,) joint jerk used for braking [rad/s³]."""
    tau_max: np.ndarray = field(default_factory=lambda: z1.TAU_MAX)
    """(7,) highest motor torque [Nm]."""
    grip_torque_nm: float = 3.0
    """The gripper's command leads its measurement by no more than this torque divided by its stiffness [Nm]."""
    gripper_lag_s: float = 0.03
    """A jaw that moves is led by as much more as it goes in this time, since it is heard of that late [s]. Without it a
    late arm's jaw would crawl, and close after the hand has turned. Where it is held up, it does not move."""
    start_error_rad: float = 0.05
    """How far the first point of a trajectory may be from the arm [rad]."""
    following_error_rad: float = 0.3
    """An arm joint further than this from its command is blocked [rad]."""
    overload_fraction: float = 0.98
    """A motor above this part of `tau_max` for `overload_s` is overloaded, and so is one asked for all of it."""
    overload_s: float = 0.1
    """See `overload_fraction` [s]."""
    brake_s: float = 0.24
    """Braking takes no longer; when `ddq_max` cannot do that, it brakes harder [s]. With the 0.15 s after which an
    owner counts as lost (`hal.process`), the command rests 0.4 s after the owner's last sign of life."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, (int, float)):
                if not (np.isfinite(value) and value > 0):
                    raise InvalidMessageError(f"ServoLimits.{entry.name} is {value}; it must be finite and above 0.")
            else:
                object.__setattr__(self, entry.name, frozen_array(value, float, (z1.N_JOINTS,), entry.name))
        if (self.q_min >= self.q_max).any():
            raise InvalidMessageError(f"ServoLimits.q_min {self.q_min} must be below q_max {self.q_max}.")


class ClippedSetpoint(NamedTuple):
    """What is left of a wish after the limits."""

    q: np.ndarray
    """(7,) joint positions [rad]."""
    dq: np.ndarray
    """(7,) joint velocities [rad/s]; 0 where the position wished lies outside the joint limits."""
    clipped: bool
    """True when an arm joint could not have what was wished (a squeezing gripper is no exception)."""


def clip_setpoint(
    limits: ServoLimits,
    q: np.ndarray,
    dq: np.ndarray,
    *,
    q_last: np.ndarray,
    q_measured: np.ndarray,
    dq_measured: np.ndarray,
) -> ClippedSetpoint:
    """Return the setpoint nearest to `q` that the arm may have this tick.

    In this order: joint positions; the gripper's lead over its measurement, so that |K_P (q − q_measured)| stays
    within the grip torque once the jaw rests (a grasp squeezes with a bounded force, whatever it was told); the step
    from `q_last`, so that no joint is ever asked for more than `dq_max`. The step comes last because it protects the
    motors.

    Args:
        limits: the limits.
        q: (7,) wished positions [rad].
        dq: (7,) wished velocities [rad/s].
        q_last: (7,) setpoint of the tick before [rad].
        q_measured: (7,) newest measurement [rad].
        dq_measured: (7,) the same of the velocities [rad/s].
    """
    allowed = np.minimum(np.maximum(q, limits.q_min), limits.q_max)
    velocity = np.minimum(np.maximum(dq, -limits.dq_max), limits.dq_max)
    # Position servos add their damping times this speed: at a limit it would push beyond it.
    velocity[allowed != q] = 0.0
    lead_rad = limits.grip_torque_nm / z1.KP[_GRIPPER]
    on_rad = min(max(dq_measured[_GRIPPER], -limits.dq_max[_GRIPPER]), limits.dq_max[_GRIPPER]) * limits.gripper_lag_s
    low, high = q_measured[_GRIPPER] - lead_rad + min(on_rad, 0.0), q_measured[_GRIPPER] + lead_rad + max(on_rad, 0.0)
    grip = min(max(allowed[_GRIPPER], low), high)
    if grip != allowed[_GRIPPER]:
        allowed[_GRIPPER] = grip
        velocity[_GRIPPER] = 0.0
    step = limits.dq_max * z1.CONTROL_PERIOD_S
    allowed = np.minimum(np.maximum(allowed, q_last - step), q_last + step)
    clipped = bool((np.abs(allowed - q)[:_GRIPPER] > 1e-9).any())
    return ClippedSetpoint(allowed, velocity, clipped)


def find_blocked(limits: ServoLimits, q_command: np.ndarray, q_measured: np.ndarray) -> str:
    """Say which arm joint does not follow its command; empty when all do."""
    error = np.abs(q_command - q_measured)[:_GRIPPER]
    if error.max() <= limits.following_error_rad:
        return ""
    worst = int(error.argmax())
    return (
        f"{z1.JOINT_NAMES[worst]} is {error[worst]:.2f} rad from its command (allowed "
        f"{limits.following_error_rad:.2f}): it is blocked or has hit something"
    )


class OverloadDetector:
    """Counts how long a motor has been at its torque limit, or asked for more than that."""

    def __init__(self, limits: ServoLimits) -> None:
        tau_max = limits.tau_max[:_GRIPPER]
        self._levels = np.stack([limits.overload_fraction * tau_max, tau_max])
        self._allowed_ticks = round(limits.overload_s / z1.CONTROL_PERIOD_S)
        self._ticks = np.zeros(self._levels.shape, dtype=int)

    def update(self, tau: np.ndarray, asked: np.ndarray) -> str:
        """Take this tick's torques; say which arm joint is overloaded, empty when none is.

        The gripper is left out: it is meant to push for as long as it holds something.

        Args:
            tau: (7,) measured [Nm].
            asked: (7,) what the position servos make of the command [Nm] (`compute_servo_torque`).
        """
        over = np.abs(np.stack([tau[:_GRIPPER], asked[:_GRIPPER]])) >= self._levels
        if not over.any():
            self._ticks[:] = 0
            return ""
        self._ticks += 1
        self._ticks *= over
        if self._ticks.max() <= self._allowed_ticks:
            return ""
        kind, joint = np.unravel_index(int(self._ticks.argmax()), self._ticks.shape)
        allowed_nm, allowed_s = self._levels[kind, joint], self._allowed_ticks * z1.CONTROL_PERIOD_S
        if kind == _MEASURED:
            what = f"has been at its torque limit ({tau[joint]:.1f} Nm of {allowed_nm:.1f})"
        else:
            what = f"does not follow: its command has asked for {asked[joint]:.1f} Nm (allowed {allowed_nm:.1f})"
        return f"{z1.JOINT_NAMES[joint]} {what} for more than {allowed_s:.2f} s: it is blocked, overloaded or lost"


def compute_servo_torque(q_command: np.ndarray, q_measured: np.ndarray) -> np.ndarray:
    """Return the torques (7,) [Nm] that the arm's position servos make of a command (7,) [rad] beside gravity's."""
    return z1.KP * (q_command - q_measured)
