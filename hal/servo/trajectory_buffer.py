"""The trajectory the servo plays: checked chunks joined end to end, read at any time between."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from hal.base.errors import CommandRejectedError
from hal.base.messages import TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S, JOINT_NAMES
from hal.servo.limits import ServoLimits

MAX_GAP_S = 0.05
"""A chunk starts at the time where the last one ended or at most this much later [s]."""
MAX_POINTS = 10_000
"""So much may wait to be played: 20 s at the servo's rate. Checking it must not hold up a stop."""
_SAME_TIME_S = 1e-6
_KEEP_S = 0.1
_ROUGHNESS = 1.05  # cubics through samples of a smooth motion overshoot its acceleration a little


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryBuffer:
    """What is buffered of one trajectory; never changed, only replaced, so that the tick needs no lock to read it."""

    trajectory_id: int
    """Which trajectory."""
    t_s: list[float]
    """(N,) times [s]; a list, which bisects faster than an array."""
    q: np.ndarray
    """(N, 7) positions [rad]."""
    dq: np.ndarray
    """(N, 7) velocities [rad/s]."""
    final: bool
    """True when its last point is the end of the trajectory."""

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
        """Return positions (N, 7) [rad] every `spacing_s` from `start_s` to the end [s]."""
        times = np.arange(start_s, self.end_s, spacing_s)
        return np.array([self.at(float(t_s))[0] for t_s in (*times, self.end_s)])


def begin(chunk: TrajectoryChunk, limits: ServoLimits) -> TrajectoryBuffer:
    """Return the playback of a new trajectory's first chunk.

    Raises:
        CommandRejectedError: it does not start at time 0, or breaks a limit.
    """
    if abs(chunk.t_s[0]) > _SAME_TIME_S:
        raise CommandRejectedError(
            f"trajectory {chunk.trajectory_id} starts at {chunk.t_s[0]:.4f} s; the first chunk starts at 0."
        )
    _check_points(chunk.trajectory_id, chunk.t_s, chunk.q, chunk.dq, limits)
    return TrajectoryBuffer(chunk.trajectory_id, chunk.t_s.tolist(), chunk.q, chunk.dq, chunk.final)


def extend(old: TrajectoryBuffer, chunk: TrajectoryChunk, played_s: float, limits: ServoLimits) -> TrajectoryBuffer:
    """Return `old` without what has been played (before `played_s` [s]) and with `chunk` behind it.

    Raises:
        CommandRejectedError: the trajectory has ended, the chunk leaves a gap or overlaps, or breaks a limit.
    """
    if old.final:
        raise CommandRejectedError(
            f"trajectory {chunk.trajectory_id} has had its final chunk (end at {old.end_s:.3f} s); start a new one."
        )
    start = float(chunk.t_s[0])
    if not -_SAME_TIME_S <= start - old.end_s <= MAX_GAP_S + _SAME_TIME_S:
        raise CommandRejectedError(
            f"chunk of trajectory {chunk.trajectory_id} starts at {start:.4f} s, but {old.end_s:.4f} s is buffered; "
            f"allowed is that time or up to {MAX_GAP_S} s after it."
        )
    # A chunk that repeats the last point brings it only once.
    skip = int(start - old.end_s <= _SAME_TIME_S)
    if skip and np.abs(chunk.q[0] - old.q[-1]).max() > (limits.dq_max * CONTROL_PERIOD_S).min():
        jump = np.abs(chunk.q[0] - old.q[-1])
        raise CommandRejectedError(
            f"chunk of trajectory {chunk.trajectory_id} repeats time {start:.4f} s with another position of "
            f"{JOINT_NAMES[int(jump.argmax())]} ({jump.max():.3f} rad away)."
        )
    keep = max(bisect_right(old.t_s, played_s - _KEEP_S) - 1, 0)
    t_s = np.concatenate([old.t_s[keep:], chunk.t_s[skip:]])
    q = np.concatenate([old.q[keep:], chunk.q[skip:]])
    dq = np.concatenate([old.dq[keep:], chunk.dq[skip:]])
    _check_points(chunk.trajectory_id, t_s, q, dq, limits)
    return TrajectoryBuffer(chunk.trajectory_id, t_s.tolist(), q, dq, chunk.final)


def _check_points(trajectory_id: int, t_s: np.ndarray, q: np.ndarray, dq: np.ndarray, limits: ServoLimits) -> None:
    if len(t_s) > MAX_POINTS:
        raise CommandRejectedError(
            f"trajectory {trajectory_id} would have {len(t_s)} points buffered; allowed are {MAX_POINTS}. "
            f"Send it in pieces, about 0.2 s before they are due."
        )
    outside = np.maximum(limits.q_min - q, q - limits.q_max)
    if outside.max() > 1e-6:
        i, j = np.unravel_index(int(outside.argmax()), outside.shape)
        raise CommandRejectedError(
            f"trajectory {trajectory_id} puts {JOINT_NAMES[j]} at {q[i, j]:.4f} rad (t = {t_s[i]:.3f} s); allowed is "
            f"{limits.q_min[j]:.4f} to {limits.q_max[j]:.4f} rad."
        )
    speed = np.abs(dq)
    if len(t_s) > 1:
        speed = np.vstack([speed, np.abs(np.diff(q, axis=0)) / np.diff(t_s)[:, None]])
    excess = speed / limits.dq_max
    if excess.max() > 1.001:
        i, j = np.unravel_index(int(excess.argmax()), excess.shape)
        raise CommandRejectedError(
            f"trajectory {trajectory_id} moves {JOINT_NAMES[j]} at {speed[i, j]:.3f} rad/s; allowed is "
            f"{limits.dq_max[j]:.3f} rad/s. Slow it down."
        )
    if len(t_s) > 1:
        _check_smoothness(trajectory_id, t_s, q, dq, limits)


def _check_smoothness(trajectory_id: int, t_s: np.ndarray, q: np.ndarray, dq: np.ndarray, limits: ServoLimits) -> None:
    """Refuse accelerations and jerks beyond the limits: of the cubics that `TrajectoryBuffer.at` lays through the points."""
    h = np.diff(t_s)[:, None]
    slope = np.diff(q, axis=0) / h
    before = (6.0 * slope - 4.0 * dq[:-1] - 2.0 * dq[1:]) / h
    after = (2.0 * dq[:-1] + 4.0 * dq[1:] - 6.0 * slope) / h
    # Between two cubics the acceleration may jump; what such a jump asks of the arm is spread over the two.
    mean = (np.diff(dq, axis=0)) / h
    jerk = np.diff(mean, axis=0) / (0.5 * (h[1:] + h[:-1]))
    for name, values, allowed, unit in (
        ("accelerates", np.maximum(np.abs(before), np.abs(after)), limits.ddq_max, "rad/s²"),
        ("jerks", np.abs(jerk), limits.dddq_max, "rad/s³"),
    ):
        if len(values) and (values / allowed).max() > _ROUGHNESS:
            i, j = np.unravel_index(int((values / allowed).argmax()), values.shape)
            raise CommandRejectedError(
                f"trajectory {trajectory_id} {name} {JOINT_NAMES[j]} with {values[i, j]:.1f} {unit} (t = {t_s[i]:.3f} "
                f"s); allowed is {allowed[j]:.1f} {unit}. Slow it down, or smooth it."
            )
