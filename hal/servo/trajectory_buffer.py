"""Buffer of the trajectory being played: checked chunks joined end to end and resampled to the ticks.

`start_buffer` and `extend_buffer` run in the producers' threads and reject a chunk that breaks a limit before the tick
can read any of it. They check the setpoints that the ticks will command, one each control period from time 0, whatever
the times of the chunk's own points are.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from hal.base.errors import CommandRejectedError
from hal.base.messages import TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S, JOINT_NAMES, N_JOINTS
from hal.servo.braking import path_stop_durations
from hal.servo.limits import SMOOTHNESS_TOLERANCE, SPEED_TOLERANCE, ServoLimits

MAX_GAP_S = 0.05
"""Maximum time between the end of one chunk and the start of the next [s]."""
MAX_BUFFER_S = 20.0
"""Maximum duration of the buffered part of a trajectory [s]."""
MAX_POINTS = 10_000
"""Maximum number of points of a chunk: `MAX_BUFFER_S` at the servo's rate."""
_SAME_TIME_S = 1e-6  # rounding of times; a control period is 2000 times as long
_ROUNDING_S = 1e-9  # of a sum of thousands of periods
_KEEP_S = 0.1  # of played points: the tick may still read the buffer a few periods behind the producer
_POSITION_TOLERANCE_RAD = 1e-6  # rounding of a point on a joint limit
_REST_ROWS = 3  # a third difference spans as many control periods


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryBuffer:
    """The buffered part of one trajectory; never changed, only replaced, so that the tick reads it without a lock."""

    trajectory_id: int
    """Identifier of the trajectory."""
    t_s: list[float]
    """(N,) times [s], multiples of the control period, and the end; a list, which bisects faster than an array."""
    q: np.ndarray
    """(N, 7) positions [rad]."""
    dq: np.ndarray
    """(N, 7) velocities [rad/s]."""
    final: bool
    """True when the last point is the end of the trajectory, where it is at rest."""
    stop_s: np.ndarray
    """(N,) duration of a stop on the path that begins at each point [s]."""

    @property
    def end_s(self) -> float:
        """Time of the last point [s]."""
        return self.t_s[-1]

    def at(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity (7,) at `t_s` [s] by cubic Hermite interpolation; the ends are held."""
        i = bisect_right(self.t_s, t_s)
        if i == 0 or i == len(self.t_s):
            i = max(i - 1, 0)
            return self.q[i], self.dq[i]
        if t_s - self.t_s[i - 1] < _ROUNDING_S:  # a tick that plays the trajectory meets its points
            return self.q[i - 1], self.dq[i - 1]
        if self.t_s[i] - t_s < _ROUNDING_S:
            return self.q[i], self.dq[i]
        h = self.t_s[i] - self.t_s[i - 1]
        s = (t_s - self.t_s[i - 1]) / h
        a, b = self.q[i - 1], self.q[i]
        da, db = self.dq[i - 1], self.dq[i]
        rise = b - a
        u = s * s * (3 - 2 * s)
        q = a + u * rise + (h * s * (1 - s)) * ((1 - s) * da - s * db)
        dq = (6 * s * (1 - s) / h) * rise + (1 - s) * (1 - 3 * s) * da + s * (3 * s - 2) * db
        return q, dq

    def stop_duration(self, t_s: float) -> float:
        """Return the duration of a stop on the path that begins at `t_s` [s]."""
        return float(self.stop_s[max(bisect_right(self.t_s, t_s + _SAME_TIME_S) - 1, 0)])

    def can_stop_from(self, t_s: float) -> bool:
        """Return True when a stop that begins at `t_s` [s] ends on the buffered path."""
        # A stop advances the path's own time by half its duration; a complete trajectory ends at rest anyway.
        return self.final or t_s + 0.5 * self.stop_duration(t_s) <= self.end_s + _SAME_TIME_S


def start_buffer(chunk: TrajectoryChunk, limits: ServoLimits) -> TrajectoryBuffer:
    """Return the buffer of a new trajectory with its first chunk.

    Raises:
        CommandRejectedError: it does not start at time 0 (`first_chunk_time`) or not at rest (`starts_in_motion`), or
            breaks a limit (see `extend_buffer`).
    """
    if abs(chunk.t_s[0]) > _SAME_TIME_S:
        raise CommandRejectedError(
            f"servo: trajectory {chunk.trajectory_id} starts at {chunk.t_s[0]:.4f} s. Start its first chunk at 0.",
            code="first_chunk_time",
        )
    _check_size(chunk, 0.0)
    t_s, q, dq = _resample(chunk.t_s, chunk.q, chunk.dq, 0, chunk.final)
    _check_points(chunk, t_s, q, dq, limits, first=True)
    return TrajectoryBuffer(chunk.trajectory_id, t_s.tolist(), q, dq, chunk.final, path_stop_durations(dq, limits))


def extend_buffer(
    old: TrajectoryBuffer, chunk: TrajectoryChunk, played_s: float, limits: ServoLimits
) -> TrajectoryBuffer:
    """Return `old` without the points played before `played_s` [s] and with `chunk` at its end.

    Raises:
        CommandRejectedError: the trajectory is complete (`trajectory_complete`), the chunk leaves a gap or overlaps
            (`chunk_gap`), jumps at the seam (`position_jump`), is too long (`buffer_full`), breaks a limit
            (`joint_limit`, `speed_limit`, `acceleration_limit`, `jerk_limit`), or is final and does not end at rest
            (`ends_in_motion`).
    """
    if old.final:
        raise CommandRejectedError(
            f"servo: trajectory {chunk.trajectory_id} has had its final chunk (end at {old.end_s:.3f} s). Start a new "
            f"trajectory.",
            code="trajectory_complete",
        )
    start = float(chunk.t_s[0])
    if not -_SAME_TIME_S <= start - old.end_s <= MAX_GAP_S + _SAME_TIME_S:
        raise CommandRejectedError(
            f"servo: a chunk of trajectory {chunk.trajectory_id} starts at {start:.4f} s, but {old.end_s:.4f} s is "
            f"buffered (allowed that time to {MAX_GAP_S} s after it). Send chunks without gaps.",
            code="chunk_gap",
        )
    # A chunk that repeats the last point adds it only once.
    skip = int(start - old.end_s <= _SAME_TIME_S)
    # More than a joint covers in one period cannot be the rounding of a repeated point.
    if skip and np.abs(chunk.q[0] - old.q[-1]).max() > (limits.dq_max * CONTROL_PERIOD_S).min():
        jump = np.abs(chunk.q[0] - old.q[-1])
        raise CommandRejectedError(
            f"servo: a chunk of trajectory {chunk.trajectory_id} repeats time {start:.4f} s with another position of "
            f"{JOINT_NAMES[int(jump.argmax())]} ({jump.max():.3f} rad apart). Repeat the last point as it was sent.",
            code="position_jump",
        )
    keep = max(bisect_right(old.t_s, played_s - _KEEP_S) - 1, 0)
    _check_size(chunk, old.t_s[keep])
    # The last point may be between two ticks: it is a knot of the new part, and no longer a point of the buffer.
    on_tick = len(old.t_s) - int(_tick_of(old.end_s) * CONTROL_PERIOD_S < old.end_s - _SAME_TIME_S)
    t_s = np.append(old.end_s, chunk.t_s[skip:])
    q, dq = np.vstack([old.q[-1], chunk.q[skip:]]), np.vstack([old.dq[-1], chunk.dq[skip:]])
    t_s, q, dq = _resample(t_s, q, dq, _tick_of(old.end_s) + 1, chunk.final)
    t_s = np.concatenate([old.t_s[keep:on_tick], t_s])
    q, dq = np.concatenate([old.q[keep:on_tick], q]), np.concatenate([old.dq[keep:on_tick], dq])
    seam = max(on_tick - keep - 1 - _REST_ROWS, 0)
    _check_points(chunk, t_s[seam:], q[seam:], dq[seam:], limits)
    stop_s = path_stop_durations(dq, limits)
    return TrajectoryBuffer(chunk.trajectory_id, t_s.tolist(), q, dq, chunk.final, stop_s)


def _tick_of(t_s: float) -> int:
    """Return the number of the last tick that is not after `t_s` [s]."""
    return int((t_s + _SAME_TIME_S) / CONTROL_PERIOD_S)


def _check_size(chunk: TrajectoryChunk, first_s: float) -> None:
    """Reject a chunk that is too long, before anything is computed from it."""
    duration_s, points = float(chunk.t_s[-1]) - first_s, len(chunk.t_s)
    if points > MAX_POINTS or not duration_s <= MAX_BUFFER_S:
        raise CommandRejectedError(
            f"servo: trajectory {chunk.trajectory_id} would have {duration_s:.4g} s buffered after a chunk of {points} "
            f"points (allowed {MAX_BUFFER_S:g} s and {MAX_POINTS} points). Send it in chunks, about 0.3 s before they "
            f"are due.",
            code="buffer_full",
        )


def _resample(
    t_s: np.ndarray, q: np.ndarray, dq: np.ndarray, first: int, final: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the cubic through the knots (K,), (K, 7), (K, 7) at the ticks from number `first`.

    The end is a point of its own where it is between two ticks; a complete trajectory holds it until the next tick.
    """
    end_s = float(t_s[-1])
    last = _tick_of(end_s)
    ragged = last * CONTROL_PERIOD_S < end_s - _SAME_TIME_S
    at_s = np.arange(first, last + 1 + int(ragged and final)) * CONTROL_PERIOD_S
    if ragged and not final:
        at_s = np.append(at_s, end_s)
    knots = t_s[len(t_s) - len(at_s) :]
    # As planned at the servo's rate, nothing is interpolated: the command is what was sent, to the last bit.
    if len(knots) == len(at_s) and (np.abs(knots - at_s) < 1e-9).all():
        n = len(t_s) - len(at_s)
        return at_s, q[n:], dq[n:]
    if len(t_s) == 1:
        return at_s, np.tile(q, (len(at_s), 1)), np.tile(dq, (len(at_s), 1))
    i = np.clip(np.searchsorted(t_s, at_s, side="right"), 1, len(t_s) - 1)
    h = (t_s[i] - t_s[i - 1])[:, None]
    s = np.clip((at_s - t_s[i - 1])[:, None] / h, 0.0, 1.0)
    rise = q[i] - q[i - 1]
    a = q[i - 1] + s * s * (3 - 2 * s) * rise + (h * s * (1 - s)) * ((1 - s) * dq[i - 1] - s * dq[i])
    da = (6 * s * (1 - s) / h) * rise + (1 - s) * (1 - 3 * s) * dq[i - 1] + s * (3 * s - 2) * dq[i]
    return at_s, a, da


def _check_points(
    chunk: TrajectoryChunk,
    t_s: np.ndarray,
    q: np.ndarray,
    dq: np.ndarray,
    limits: ServoLimits,
    *,
    first: bool = False,
) -> None:
    """Reject points that break a limit of position, speed, acceleration or jerk, or that begin or end in motion."""
    outside = np.maximum(limits.q_min - q, q - limits.q_max)
    if not outside.max() <= _POSITION_TOLERANCE_RAD:
        i, j = np.unravel_index(int(outside.argmax()), outside.shape)
        raise CommandRejectedError(
            f"servo: trajectory {chunk.trajectory_id} moves {JOINT_NAMES[j]} to {q[i, j]:.4f} rad at t = {t_s[i]:.3f} "
            f"s (allowed {limits.q_min[j]:.4f} to {limits.q_max[j]:.4f} rad). Plan within the joint limits.",
            code="joint_limit",
        )
    # Before its start and after its end the arm is at rest: these rows make the checks below cover both.
    rest = np.zeros((_REST_ROWS, N_JOINTS))
    before = _REST_ROWS if first else 0
    if first:
        _check_rest(chunk, dq[0], limits, "starts")
        q, dq = np.concatenate([rest + q[0], q]), np.concatenate([rest, dq])
    if chunk.final:
        _check_rest(chunk, dq[-1], limits, "ends")
        q, dq = np.concatenate([q, rest + q[-1]]), np.concatenate([dq, rest])
    elif len(t_s) > 1 and t_s[-1] - t_s[-2] < CONTROL_PERIOD_S - _SAME_TIME_S:
        q, dq = q[:-1], dq[:-1]  # the end between two ticks, which is checked when it is extended
    for name, values, allowed, unit in _rates(q, dq, limits):
        excess = np.abs(values) / allowed
        if len(values) and not excess.max() <= 1.0:
            i, j = np.unravel_index(int(excess.argmax()), excess.shape)
            at_s = t_s[min(max(int(i) - before, 0), len(t_s) - 1)]
            raise CommandRejectedError(
                f"servo: trajectory {chunk.trajectory_id} has {name} {values[i, j]:.1f} {unit} of {JOINT_NAMES[j]} at "
                f"t = {at_s:.3f} s (allowed {allowed[j]:.1f} {unit}). Slow it down, smooth it, or send it with points "
                f"every 0.002 s.",
                code=f"{name}_limit",
            )


def _rates(q: np.ndarray, dq: np.ndarray, limits: ServoLimits) -> list[tuple[str, np.ndarray, np.ndarray, str]]:
    """Return name, values (N, 7), limits (7,) and unit of the rates of the points and of the cubics between them."""
    h = CONTROL_PERIOD_S
    slope = np.diff(q, axis=0) / h
    begin = (6.0 * slope - 4.0 * dq[:-1] - 2.0 * dq[1:]) / h
    end = (2.0 * dq[:-1] + 4.0 * dq[1:] - 6.0 * slope) / h
    # A stop samples the cubics more densely than the ticks, and meets the steps of acceleration between them.
    steps = (begin[1:] - end[:-1]) / h
    ddq_max, dddq_max = SMOOTHNESS_TOLERANCE * limits.ddq_max, SMOOTHNESS_TOLERANCE * limits.dddq_max
    return [
        ("speed", dq, SPEED_TOLERANCE * limits.dq_max, "rad/s"),
        ("speed", slope, SPEED_TOLERANCE * limits.dq_max, "rad/s"),
        ("acceleration", begin, ddq_max, "rad/s²"),
        ("acceleration", end, ddq_max, "rad/s²"),
        ("jerk", np.diff(slope, n=2, axis=0) / h**2, dddq_max, "rad/s³"),
        ("jerk", steps, 2.0 * dddq_max, "rad/s³"),
    ]


def _check_rest(chunk: TrajectoryChunk, dq: np.ndarray, limits: ServoLimits, verb: str) -> None:
    """Reject a first or last point in motion: the arm is at rest before the one and after the other."""
    allowed = SMOOTHNESS_TOLERANCE * limits.dddq_max * CONTROL_PERIOD_S**2  # the speed that the jerk gives in one tick
    if (np.abs(dq) <= allowed).all():
        return
    j = int((np.abs(dq) / allowed).argmax())
    raise CommandRejectedError(
        f"servo: trajectory {chunk.trajectory_id} {verb} with {dq[j]:.4f} rad/s of {JOINT_NAMES[j]} (allowed "
        f"{allowed[j]:.4f} rad/s). Plan it from rest to rest.",
        code=f"{verb}_in_motion",
    )
