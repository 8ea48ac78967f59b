"""Limits between the servo and the arm: joint positions, speed, grip torque, and detection of blocked joints."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import NamedTuple

import numpy as np

from hal.base import z1
from hal.base.errors import InvalidMessageError
from hal.base.messages import frozen_array

SPEED_TOLERANCE = 1.001
"""Difference quotients of a motion at full speed exceed it by rounding."""
SMOOTHNESS_TOLERANCE = 1.05
"""Cubics through samples of a smooth motion overshoot its acceleration and jerk a little."""
_GRIPPER = z1.N_ARM
_ROUNDING_RAD = 1e-9
_MEASURED = 0  # row of `OverloadDetector._levels`


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ServoLimits:
    """Limits of the servo; the defaults are the Z1's (`hal.base.z1`)."""

    q_min: np.ndarray = field(default_factory=lambda: z1.Q_MIN)
    """(7,) minimum joint positions [rad]."""
    q_max: np.ndarray = field(default_factory=lambda: z1.Q_MAX)
    """(7,) maximum joint positions [rad]."""
    dq_max: np.ndarray = field(default_factory=lambda: z1.DQ_MAX)
    """(7,) maximum joint speeds [rad/s]."""
    ddq_max: np.ndarray = field(default_factory=lambda: z1.DDQ_MAX)
    """(7,) maximum joint accelerations of a motion [rad/s²]."""
    dddq_max: np.ndarray = field(default_factory=lambda: z1.DDDQ_MAX)
    """(7,) maximum joint jerks of a motion [rad/s³]."""
    brake_ddq_max: np.ndarray = field(default_factory=lambda: 3.0 * z1.DDQ_MAX)
    """(7,) maximum joint accelerations of a stop [rad/s²]. A motion at full speed cannot end within `brake_s` at
    `ddq_max`; three times as much is what slowing down on its path needs (`path_stop_peaks`)."""
    brake_dddq_max: np.ndarray = field(default_factory=lambda: 6.0 * z1.DDDQ_MAX)
    """(7,) maximum joint jerks of a stop [rad/s³]; six times `dddq_max` for the same reason."""
    tau_max: np.ndarray = field(default_factory=lambda: z1.TAU_MAX)
    """(7,) maximum motor torques [Nm]."""
    grip_torque_nm: float = 3.0
    """The gripper's command leads its measurement by at most this torque divided by its stiffness [Nm]."""
    gripper_lag_s: float = 0.03
    """Latency of the gripper's measurement [s]: a jaw in motion may be led by the distance it covers in this time as
    well. Without it the jaw of a slow link would crawl, and close after the gripper has turned. A blocked jaw does not
    move and gets no extra lead."""
    start_error_rad: float = 0.05
    """Maximum distance of a trajectory's first point from the arm, per joint [rad]."""
    following_error_rad: float = 0.3
    """An arm joint further than this from its command counts as blocked [rad]."""
    overload_fraction: float = 0.98
    """A motor above this ratio of `tau_max` for `overload_s` is overloaded, and so is one whose command asks for all of
    `tau_max`."""
    overload_s: float = 0.1
    """See `overload_fraction` [s]."""
    brake_s: float = 0.24
    """Maximum duration of a stop [s]; a slower motion takes less, at the motion's own limits. With the heartbeat
    timeout of 0.15 s (`hal.process`) the command is at rest within 0.4 s of the owner's last heartbeat."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, (int, float)):
                if not (np.isfinite(value) and value > 0):
                    raise InvalidMessageError(
                        f"ServoLimits.{entry.name} is {value}; it must be finite and above 0.", code="invalid_limit"
                    )
            else:
                object.__setattr__(self, entry.name, frozen_array(value, float, (z1.N_JOINTS,), entry.name))
        if (self.q_min >= self.q_max).any():
            raise InvalidMessageError(
                f"ServoLimits.q_min {self.q_min} must be below q_max {self.q_max}.", code="invalid_limit"
            )
        for name, needed in zip(("brake_ddq_max", "brake_dddq_max"), path_stop_peaks(self), strict=True):
            if (needed > SMOOTHNESS_TOLERANCE * getattr(self, name)).any():
                raise InvalidMessageError(
                    f"ServoLimits.{name} is {getattr(self, name)}; a stop from dq_max within brake_s needs {needed}.",
                    code="invalid_limit",
                )


def path_stop_peaks(limits: ServoLimits) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds (7,) of acceleration [rad/s²] and jerk [rad/s³] of every stop on the path of a legal motion.

    The stop slows the path's time down by 1 − 3u² + 2u³, u = t / `brake_s` (`hal.servo.braking`).
    """
    u = np.linspace(0.0, 1.0, 101)[:, None]
    rate, slope, bend = 1 - 3 * u**2 + 2 * u**3, 6 * u * (1 - u) / limits.brake_s, (6 - 12 * u) / limits.brake_s**2
    v, a, j = limits.dq_max, limits.ddq_max, limits.dddq_max
    acceleration = a * rate**2 + v * slope
    jerk = j * rate**3 + 3 * a * rate * slope + v * np.abs(bend)
    return acceleration.max(axis=0), jerk.max(axis=0)


class ClippedSetpoint(NamedTuple):
    """A desired setpoint after the limits."""

    q: np.ndarray
    """(7,) joint positions [rad]."""
    dq: np.ndarray
    """(7,) joint velocities [rad/s]; 0 where the desired position is outside the joint limits."""
    clipped: bool
    """True when a limit changed an arm joint's position (a squeezing gripper is clipped by design)."""


def clip_setpoint(
    limits: ServoLimits,
    q: np.ndarray,
    dq: np.ndarray,
    *,
    q_last: np.ndarray,
    q_measured: np.ndarray,
    dq_measured: np.ndarray,
    q_command: np.ndarray | None = None,
) -> ClippedSetpoint:
    """Return the setpoint nearest to `q` that the limits allow this tick.

    In this order: joint positions; the gripper's lead over its measurement, so that |K_P (q − q_measured)| stays
    within the grip torque once the jaw is at rest (a grasp squeezes with a bounded force, whatever its command); the
    step from `q_last`, so that no joint exceeds `dq_max`. The step comes last because it protects the motors.

    Args:
        limits: the limits.
        q: (7,) desired positions [rad].
        dq: (7,) desired velocities [rad/s].
        q_last: (7,) setpoint of the tick before [rad].
        q_measured: (7,) newest measured positions [rad].
        dq_measured: (7,) newest measured velocities [rad/s].
        q_command: (7,) command of the tick before, which the arm itself may have limited further [rad]. A joint that
            is outside its limits there, as one that rests on its stop may be by the error of its encoder, may stay;
            None = it has to return.
    """
    q_min = limits.q_min if q_command is None else np.minimum(limits.q_min, q_command)
    q_max = limits.q_max if q_command is None else np.maximum(limits.q_max, q_command)
    lead_rad = limits.grip_torque_nm / z1.KP[_GRIPPER]
    # A measured speed beyond the joint's own is an error of measurement and must not extend the lead.
    on_rad = min(max(dq_measured[_GRIPPER], -limits.dq_max[_GRIPPER]), limits.dq_max[_GRIPPER]) * limits.gripper_lag_s
    low, high = q_measured[_GRIPPER] - lead_rad + min(on_rad, 0.0), q_measured[_GRIPPER] + lead_rad + max(on_rad, 0.0)
    step = SPEED_TOLERANCE * limits.dq_max * z1.CONTROL_PERIOD_S
    lowest = np.maximum(q_min, q_last - step)
    highest = np.minimum(q_max, q_last + step)
    velocity = np.minimum(np.maximum(dq, -limits.dq_max), limits.dq_max)
    # As at nearly every tick; `&` of two arrays and one `all` are half the time of what follows.
    if low <= q[_GRIPPER] <= high and ((q >= lowest) & (q <= highest)).all():
        return ClippedSetpoint(q.copy(), velocity, False)
    allowed = np.minimum(np.maximum(q, q_min), q_max)
    # The motors' servos add damping times this speed: at a position limit it would push beyond it.
    velocity[allowed != q] = 0.0
    grip = min(max(allowed[_GRIPPER], low), high)
    if grip != allowed[_GRIPPER]:
        allowed[_GRIPPER] = grip
        velocity[_GRIPPER] = 0.0
    allowed = np.minimum(np.maximum(allowed, q_last - step), q_last + step)
    clipped = bool((np.abs(allowed - q)[:_GRIPPER] > _ROUNDING_RAD).any())
    return ClippedSetpoint(allowed, velocity, clipped)


def find_blocked(limits: ServoLimits, q_command: np.ndarray, q_measured: np.ndarray) -> str:
    """Return a description of the arm joint that does not follow its command; empty when all do."""
    error = np.abs(q_command - q_measured)[:_GRIPPER]
    if error.max() <= limits.following_error_rad:
        return ""
    worst = int(error.argmax())
    return (
        f"{z1.JOINT_NAMES[worst]} is {error[worst]:.2f} rad from its command (allowed "
        f"{limits.following_error_rad:.2f}): it is blocked or in collision"
    )


class OverloadDetector:
    """A counter of the ticks that each motor spends at its torque limit, or with a command that asks for more."""

    def __init__(self, limits: ServoLimits) -> None:
        tau_max = limits.tau_max[:_GRIPPER]
        self._levels = np.stack([limits.overload_fraction * tau_max, tau_max])
        self._allowed_ticks = round(limits.overload_s / z1.CONTROL_PERIOD_S)
        self._ticks = np.zeros(self._levels.shape, dtype=int)

    def update(self, tau: np.ndarray, requested: np.ndarray) -> str:
        """Count this tick's torques; return a description of the overloaded arm joint, empty when none is.

        The gripper is left out: it pushes for as long as it holds an object.

        Args:
            tau: (7,) measured torques [Nm].
            requested: (7,) torques that the position servos compute from the command [Nm] (`compute_servo_torque`).
        """
        over = np.abs(np.stack([tau[:_GRIPPER], requested[:_GRIPPER]])) >= self._levels
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
            what = f"does not follow: its command has asked for {requested[joint]:.1f} Nm (allowed {allowed_nm:.1f})"
        return f"{z1.JOINT_NAMES[joint]} {what} for more than {allowed_s:.2f} s: it is blocked, overloaded or lost"


def compute_servo_torque(q_command: np.ndarray, q_measured: np.ndarray) -> np.ndarray:
    """Return the torques (7,) [Nm] of the arm's position servos for a command (7,) [rad], without gravity's."""
    return z1.KP * (q_command - q_measured)
