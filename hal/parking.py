"""Folding the arm, slowly, before its motors go soft: what a HAL process does last when its rig asks for it."""

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

_LOG = logging.getLogger(__name__)
_OWNER = "the HAL's ending"
_LOOK_S = 0.02
_BRAKING_S = 2.0
_TELL_S = 2.0
_SPACING_S = 0.02
_SHORTEST_S = 0.5
_SQUEEZES_NM = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Parking:
    """Where and how an arm is parked."""

    q: np.ndarray
    """(6,) the folded pose [rad], in which it lies without its motors."""
    speed_rad_s: float = 0.3
    """No joint is faster on the way there [rad/s]."""
    disable_motors: Callable[[], None] | None = None
    """Lets the motors go, once it lies there and nothing ticks any more; None = they hold."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "q", frozen_array(self.q, float, (z1.N_ARM,), "Parking.q"))


def park(servo: Servo, parking: Parking, give_up: Event) -> bool:
    """Take the arm from whoever commands it, brake it, fold it, and say how it goes; whether it lies there now.

    The way is straight in joint space, or by way of home when the guard forbids that. A stop, a fault or `give_up`
    ends it, and the arm brakes and holds; a stop that was latched before is left alone.

    Args:
        servo: ticked by another thread.
        parking: where to.
        give_up: set when somebody does not want to wait for it.
    """
    try:
        _take_over(servo)
        if abs(servo.read_state().tau[z1.N_ARM]) > _SQUEEZES_NM:
            raise CommandRejectedError("the gripper holds something.")
        try:
            _move_to(servo, parking.q, parking.speed_rad_s, give_up)
        except GuardError as error:
            _LOG.info("parking by way of home: %s", error)
            for station in (z1.Q_HOME, parking.q):
                _move_to(servo, station, parking.speed_rad_s, give_up)
    except HalError as error:
        _LOG.warning("not parked: %s The arm holds where it is: support it before you switch it off.", error)
        return False
    _LOG.info("parked")
    return True


def _take_over(servo: Servo) -> None:
    servo.release()
    servo.claim(_OWNER)
    pause, waited_s = Event(), 0.0
    while servo.status().mode in (ServoMode.TRACKING, ServoMode.BRAKING) and waited_s < _BRAKING_S:
        pause.wait(_LOOK_S)
        waited_s += _LOOK_S
        servo.heartbeat(_OWNER)


def _move_to(servo: Servo, station: np.ndarray, speed_rad_s: float, give_up: Event) -> None:
    """Move the arm to `station` (6,) [rad] and wait for it.

    Raises:
        GuardError: the way is not allowed; nothing has moved.
        StoppedError: a stop or a fault came in between.
        HalError: it was given up.
    """
    status = servo.status()
    goal = np.append(station, status.q_command[z1.N_ARM])
    motion = plan_quintic(status.trajectory_id + 1, status.q_command, goal, speed_rad_s, servo.limits)
    servo.stream(motion)
    duration_s, told_s = float(motion.t_s[-1]), -_TELL_S
    while (status := servo.status()).trajectory_id != motion.trajectory_id or not status.finished:
        dropped = status.trajectory_id == motion.trajectory_id and status.mode is not ServoMode.TRACKING
        if dropped or status.mode is ServoMode.STOPPED:
            raise StoppedError(status.reason)
        if give_up.wait(_LOOK_S):
            raise HalError("somebody did not want to wait for it.")
        servo.heartbeat(_OWNER)
        if status.trajectory_time_s - told_s >= _TELL_S:
            told_s = status.trajectory_time_s
            _LOG.info("parking: %.0f of %.0f s (Ctrl-C again, or `./z1 stop`, ends it)", told_s, duration_s)


def plan_quintic(
    trajectory_id: int, start: np.ndarray, goal: np.ndarray, speed_rad_s: float, limits: ServoLimits
) -> TrajectoryChunk:
    """Return the motion from rest at `start` (7,) to rest at `goal` (7,) [rad] at that speed, or slower for a limit."""
    step = goal - start
    far = np.abs(step)
    # The peaks of a quintic from rest to rest over its duration T: 15/8 d/T, 5.78 d/T², 60 d/T³.
    times_s = (1.875 * far / speed_rad_s, np.sqrt(5.78 * far / limits.ddq_max), np.cbrt(60.0 * far / limits.dddq_max))
    duration_s = max(float(np.max(times_s)), _SHORTEST_S)
    u = np.linspace(0.0, 1.0, round(duration_s / _SPACING_S) + 1)
    return TrajectoryChunk(
        trajectory_id=trajectory_id,
        t_s=u * duration_s,
        q=start + (10 * u**3 - 15 * u**4 + 6 * u**5)[:, None] * step,
        dq=(30 * u**2 - 60 * u**3 + 30 * u**4)[:, None] / duration_s * step,
        final=True,
    )
