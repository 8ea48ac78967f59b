"""Parking: slow folding of the arm before its motors are disabled, at the end of a HAL process that asks for it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from threading import Event

import numpy as np

from hal.base import z1
from hal.base.errors import CommandRejectedError, GuardError, HalError, StoppedError
from hal.base.messages import ServoMode, TrajectoryChunk, frozen_array
from hal.servo.limits import ServoLimits
from hal.servo.servo import Servo
from hal.servo.trajectory_buffer import MAX_BUFFER_S

_LOG = logging.getLogger(__name__)
_OWNER = "HAL parking"
_POLL_S = 0.02  # each poll sends a heartbeat: 50 Hz, the rate of any client
_MAX_BRAKING_S = 2.0  # as in `hal.process`: several times `ServoLimits.brake_s`
_PROGRESS_PERIOD_S = 2.0
_SPACING_S = 0.02
_MIN_DURATION_S = 0.5
_GRIP_TORQUE_NM = 1.0  # a third of `ServoLimits.grip_torque_nm`, with which an object is held


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Parking:
    """Pose and speed of parking an arm."""

    q: np.ndarray
    """(6,) folded pose [rad], in which the arm rests without its motors."""
    speed_rad_s: float = 0.3
    """Maximum joint speed [rad/s]; more where the motion would take longer than `MAX_BUFFER_S`."""
    disable_motors: Callable[[], None] | None = None
    """Disables the motors, after the last tick of a parked arm; None = they hold."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "q", frozen_array(self.q, float, (z1.N_ARM,), "Parking.q"))


def park(servo: Servo, parking: Parking, abort: Event) -> bool:
    """Take over the arm, brake it and fold it, with log lines of the progress; return True when it is parked.

    The path is straight in joint space, or by way of home where the guard forbids that. A stop, a fault or `abort` ends
    it, and the arm brakes and holds; a stop that was latched before stays latched.

    Args:
        servo: ticked by another thread.
        parking: pose and speed.
        abort: set by the operator to end the parking.
    """
    try:
        _take_over(servo)
        if abs(servo.read_state().tau[z1.N_ARM]) > _GRIP_TORQUE_NM:
            raise CommandRejectedError("the gripper holds an object.", code="gripper_loaded")
        try:
            _move_to(servo, parking.q, parking.speed_rad_s, abort)
        except GuardError as error:
            _LOG.info("parking by way of home: %s", error)
            for station in (z1.Q_HOME, parking.q):
                _move_to(servo, station, parking.speed_rad_s, abort)
    except HalError as error:
        _LOG.warning("not parked: %s The arm stays where it is: support it before it is switched off or let go.", error)
        return False
    _LOG.info("parked")
    return True


def _take_over(servo: Servo) -> None:
    servo.release()  # of whichever client owns it; a motion of that client brakes
    servo.claim(_OWNER)
    pause, waited_s = Event(), 0.0
    while servo.status().mode in (ServoMode.TRACKING, ServoMode.BRAKING) and waited_s < _MAX_BRAKING_S:
        pause.wait(_POLL_S)
        waited_s += _POLL_S
        servo.heartbeat(_OWNER)


def _move_to(servo: Servo, station: np.ndarray, speed_rad_s: float, abort: Event) -> None:
    """Move the arm to `station` (6,) [rad] and wait for it.

    Raises:
        GuardError: the path violates the guard; nothing has moved.
        StoppedError: a stop or a fault ended the motion.
        HalError: the operator aborted it (`aborted`).
    """
    status = servo.status()
    goal = np.append(station, status.q_command[z1.N_ARM])
    motion = _plan_quintic(status.trajectory_id + 1, status.q_command, goal, speed_rad_s, servo.limits)
    servo.stream(motion)
    duration_s, logged_s = float(motion.t_s[-1]), -_PROGRESS_PERIOD_S
    while (status := servo.status()).trajectory_id != motion.trajectory_id or not status.finished:
        dropped = status.trajectory_id == motion.trajectory_id and status.mode is not ServoMode.TRACKING
        if dropped or status.mode is ServoMode.STOPPED:
            raise StoppedError(status.reason)
        if abort.wait(_POLL_S):
            raise HalError("parking aborted by the operator.", code="aborted")
        servo.heartbeat(_OWNER)
        if status.trajectory_time_s - logged_s >= _PROGRESS_PERIOD_S:
            logged_s = status.trajectory_time_s
            _LOG.info("parking: %.0f of %.0f s (Ctrl-C again, or `./z1 stop`, ends it)", logged_s, duration_s)


def _plan_quintic(
    trajectory_id: int, start: np.ndarray, goal: np.ndarray, speed_rad_s: float, limits: ServoLimits
) -> TrajectoryChunk:
    """Return the motion from rest at `start` (7,) to rest at `goal` (7,) [rad] at that speed, or slower for a limit."""
    step = goal - start
    distance = np.abs(step)
    # Peaks of a quintic from rest to rest over its duration T: speed 15/8 d/T, acceleration 5.78 d/T², jerk 60 d/T³.
    times_s = (
        1.875 * distance / speed_rad_s,
        np.sqrt(5.78 * distance / limits.ddq_max),
        np.cbrt(60.0 * distance / limits.dddq_max),
    )
    # One chunk, so that nothing moves where a part of the path is not allowed; a slower one would not be accepted.
    duration_s = min(max(float(np.max(times_s)), _MIN_DURATION_S), MAX_BUFFER_S)
    u = np.linspace(0.0, 1.0, round(duration_s / _SPACING_S) + 1)
    return TrajectoryChunk(
        trajectory_id=trajectory_id,
        t_s=u * duration_s,
        q=start + (10 * u**3 - 15 * u**4 + 6 * u**5)[:, None] * step,
        dq=(30 * u**2 - 60 * u**3 + 30 * u**4)[:, None] / duration_s * step,
        final=True,
    )
