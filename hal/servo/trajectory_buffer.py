"""Buffer of the trajectory being played: checked chunks joined end to end, interpolated at any time.

`start_buffer` and `extend_buffer` run in the producers' threads and reject a chunk that breaks a limit before the tick
can read any of it.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from hal.base.errors import CommandRejectedError
from hal.base.messages import TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S, JOINT_NAMES
from hal.servo.limits import ServoLimits

MAX_GAP_S = 0.05
"""Maximum time between the end of one chunk and the start of the next [s]."""
MAX_POINTS = 10_000
"""Maximum number of buffered points: 20 s at the servo's rate. Checking more would delay a stop."""
_SAME_TIME_S = 1e-6  # rounding of times; a control period is 2000 times as long
_KEEP_S = 0.1  # of played points: the tick may still read the buffer a few periods behind the producer
_POSITION_TOLERANCE_RAD = 1e-6  # rounding of a point on a joint limit
_SPEED_TOLERANCE = 1.001  # difference quotients of a motion at full speed exceed it by rounding
_SMOOTHNESS_TOLERANCE = 1.05  # cubics through samples of a smooth motion overshoot its acceleration a little


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryBuffer:
    """The buffered part of one trajectory; never changed, only replaced, so that the tick reads it without a lock."""

    trajectory_id: int
    """Identifier of the trajectory."""
    t_s: list[float]
    """(N,) times [s]; a list, which bisects faster than an array."""
    q: np.ndarray
    """(N, 7) positions [rad]."""
    dq: np.ndarray
    """(N, 7) velocities [rad/s]."""
    final: bool
    """True when the last point is the end of the trajectory."""

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
        h = self.t_s[i] - self.t_s[i - 1]
        s = (t_s - self.t_s[i - 1]) / h
        a, b = self.q[i - 1], self.q[i]
        da, db = self.dq[i - 1], self.dq[i]
        rise = b - a
        u = s * s * (3 - 2 * s)
        q = a + u * rise + (h * s * (1 - s)) * ((1 - s) * da - s * db)
        dq = (6 * s * (1 - s) / h) * rise + (1 - s) * (1 - 3 * s) * da + s * (3 * s - 2) * db
        return q, dq

    def sample_positions(self, start_s: float, spacing_s: float) -> np.ndarray:
        """Return positions (N, 7) [rad] every `spacing_s` [s] from `start_s` [s] to the end, the end included."""
        times = np.arange(start_s, self.end_s, spacing_s)
        return np.array([self.at(float(t_s))[0] for t_s in (*times, self.end_s)])


def start_buffer(chunk: TrajectoryChunk, limits: ServoLimits) -> TrajectoryBuffer:
    """Return the buffer of a new trajectory with its first chunk.

    Raises:
        CommandRejectedError: it does not start at time 0 (`first_chunk_time`), or breaks a limit (see `extend_buffer`).
    """
    if abs(chunk.t_s[0]) > _SAME_TIME_S:
        raise CommandRejectedError(
            f"servo: trajectory {chunk.trajectory_id} starts at {chunk.t_s[0]:.4f} s. Start its first chunk at 0.",
            code="first_chunk_time",
        )
    _check_points(chunk.trajectory_id, chunk.t_s, chunk.q, chunk.dq, limits)
    return TrajectoryBuffer(chunk.trajectory_id, chunk.t_s.tolist(), chunk.q, chunk.dq, chunk.final)


def extend_buffer(
    old: TrajectoryBuffer, chunk: TrajectoryChunk, played_s: float, limits: ServoLimits
) -> TrajectoryBuffer:
    """Return `old` without the points played before `played_s` [s] and with `chunk` at its end.

    Raises:
        CommandRejectedError: the trajectory is complete (`trajectory_complete`), the chunk leaves a gap or overlaps
            (`chunk_gap`), jumps at the seam (`position_jump`), is too long (`buffer_full`), or breaks a limit
            (`joint_limit`, `speed_limit`, `acceleration_limit`, `jerk_limit`).
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
    t_s = np.concatenate([old.t_s[keep:], chunk.t_s[skip:]])
    q = np.concatenate([old.q[keep:], chunk.q[skip:]])
    dq = np.concatenate([old.dq[keep:], chunk.dq[skip:]])
    _check_points(chunk.trajectory_id, t_s, q, dq, limits)
    return TrajectoryBuffer(chunk.trajectory_id, t_s.tolist(), q, dq, chunk.final)


def _check_points(trajectory_id: int, t_s: np.ndarray, q: np.ndarray, dq: np.ndarray, limits: ServoLimits) -> None:
    """Reject a buffer that is too long or breaks a limit of position, speed, acceleration or jerk."""
    if len(t_s) > MAX_POINTS:
        raise CommandRejectedError(
            f"servo: trajectory {trajectory_id} would have {len(t_s)} points buffered (allowed {MAX_POINTS}). "
            f"Send it in chunks, about 0.2 s before they are due.",
            code="buffer_full",
        )
    outside = np.maximum(limits.q_min - q, q - limits.q_max)
    if outside.max() > _POSITION_TOLERANCE_RAD:
        i, j = np.unravel_index(int(outside.argmax()), outside.shape)
        raise CommandRejectedError(
            f"servo: trajectory {trajectory_id} moves {JOINT_NAMES[j]} to {q[i, j]:.4f} rad at t = {t_s[i]:.3f} s "
            f"(allowed {limits.q_min[j]:.4f} to {limits.q_max[j]:.4f} rad). Plan within the joint limits.",
            code="joint_limit",
        )
    speed = np.abs(dq)
    if len(t_s) > 1:
        speed = np.vstack([speed, np.abs(np.diff(q, axis=0)) / np.diff(t_s)[:, None]])
    excess = speed / limits.dq_max
    if excess.max() > _SPEED_TOLERANCE:
        i, j = np.unravel_index(int(excess.argmax()), excess.shape)
        raise CommandRejectedError(
            f"servo: trajectory {trajectory_id} moves {JOINT_NAMES[j]} at {speed[i, j]:.3f} rad/s (allowed "
            f"{limits.dq_max[j]:.3f} rad/s). Slow it down.",
            code="speed_limit",
        )
    if len(t_s) > 1:
        _check_smoothness(trajectory_id, t_s, q, dq, limits)


def _check_smoothness(trajectory_id: int, t_s: np.ndarray, q: np.ndarray, dq: np.ndarray, limits: ServoLimits) -> None:
    """Reject accelerations and jerks of the interpolated cubics (`TrajectoryBuffer.at`) beyond the limits."""
    h = np.diff(t_s)[:, None]
    slope = np.diff(q, axis=0) / h
    before = (6.0 * slope - 4.0 * dq[:-1] - 2.0 * dq[1:]) / h
    after = (2.0 * dq[:-1] + 4.0 * dq[1:] - 6.0 * slope) / h
    # Between two cubics the acceleration may jump; the jerk of such a jump is averaged over both.
    mean = (np.diff(dq, axis=0)) / h
    jerk = np.diff(mean, axis=0) / (0.5 * (h[1:] + h[:-1]))
    for name, values, allowed, unit in (
        ("acceleration", np.maximum(np.abs(before), np.abs(after)), limits.ddq_max, "rad/s²"),
        ("jerk", np.abs(jerk), limits.dddq_max, "rad/s³"),
    ):
        if len(values) and (values / allowed).max() > _SMOOTHNESS_TOLERANCE:
            i, j = np.unravel_index(int((values / allowed).argmax()), values.shape)
            raise CommandRejectedError(
                f"servo: trajectory {trajectory_id} has {name} {values[i, j]:.1f} {unit} of {JOINT_NAMES[j]} at t = "
                f"{t_s[i]:.3f} s (allowed {allowed[j]:.1f} {unit}). Slow it down, or smooth it.",
                code=f"{name}_limit",
            )
