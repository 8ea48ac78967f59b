"""Messages between processes and packages: frozen, stamped, in SI units, with read-only arrays.

Poses are `T_parent_child` with `p_parent = T_parent_child @ p_child`. Joint vectors are in `hal.base.z1.JOINT_NAMES`
order, six arm joints and then the gripper. Stamps are seconds of the clock of the process that made the message.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import Enum
from functools import cache
from typing import Any

import numpy as np

from hal.base.errors import InvalidMessageError
from hal.base.z1 import N_JOINTS

MAX_MAGNITUDE = 1e6
"""Maximum magnitude of every number of an array; joint speeds, torques and distances are below 1e3 in SI units."""
MAX_STAMP_S = 1e11
"""Maximum magnitude of a time [s], three thousand years."""
MAX_COUNT = 2**53
"""Maximum magnitude of an integer; up to it, floats hold all of them."""
MAX_TEXT = 4000
"""Maximum length of a text."""
MAX_CHUNK_POINTS = 100_000
"""Maximum number of points of a trajectory chunk; the servo accepts a tenth of it."""
MIN_SPACING_S = 1e-6
"""Minimum time between two points of a trajectory [s]; less would make quotients of differences meaningless."""


def frozen_array(value: Any, dtype: Any, shape: tuple[int | None, ...], name: str) -> np.ndarray:
    """Return a read-only copy of `value` as an array of `dtype`, checked against `shape` (None = any length).

    Raises:
        InvalidMessageError: wrong shape (`wrong_shape`), or a float that is not finite (`not_finite`) or larger than
            `MAX_MAGNITUDE` (`out_of_range`).
    """
    array = np.array(value, dtype=dtype)  # a copy: the caller's own array stays writable
    if array.shape != shape and (
        array.ndim != len(shape)
        or any(want is not None and want != have for want, have in zip(shape, array.shape, strict=True))
    ):
        raise InvalidMessageError(
            f"{name} has shape {array.shape} (allowed {shape}, None = any length).", code="wrong_shape"
        )
    if array.dtype.kind == "f":
        flat = array.ravel()
        # The sum of squares bounds them all, and is NaN or infinite with one of them: much faster than `isfinite`.
        with np.errstate(over="ignore", invalid="ignore"):
            bounded = flat.dot(flat) <= MAX_MAGNITUDE
        if not bounded:
            _check_magnitudes(flat, name)
    array.setflags(write=False)
    return array


def _check_magnitudes(flat: np.ndarray, name: str) -> None:
    if not np.isfinite(flat).all():
        raise InvalidMessageError(
            f"{name} has values that are not finite ({flat[~np.isfinite(flat)][:3]}).", code="not_finite"
        )
    if np.abs(flat).max() > MAX_MAGNITUDE:
        raise InvalidMessageError(
            f"{name} has a value of {np.abs(flat).max():.4g} (allowed up to {MAX_MAGNITUDE:g}).", code="out_of_range"
        )


def _freeze(message: Any, **arrays: tuple[Any, tuple[int | None, ...]]) -> None:
    """Replace the message's `arrays` by read-only copies of the dtype and shape, and check all its other fields."""
    kind = type(message)
    for name, (dtype, shape) in arrays.items():
        object.__setattr__(message, name, frozen_array(getattr(message, name), dtype, shape, f"{kind.__name__}.{name}"))
    for name in _plain_fields(kind):
        _check_plain(getattr(message, name), f"{kind.__name__}.{name}")


@cache
def _plain_fields(kind: type) -> tuple[str, ...]:
    """Return the names of the fields whose types are not arrays, as written in the class."""
    return tuple(field.name for field in fields(kind) if "ndarray" not in str(field.type))


def _check_plain(value: Any, label: str) -> None:
    """Reject a number or a text out of its range."""
    if isinstance(value, float):
        if not np.isfinite(value):
            raise InvalidMessageError(f"{label} is {value} (allowed finite values).", code="not_finite")
        if abs(value) > MAX_STAMP_S:
            raise InvalidMessageError(f"{label} is {value:.4g} (allowed up to {MAX_STAMP_S:g}).", code="out_of_range")
    elif isinstance(value, int) and abs(value) > MAX_COUNT:
        raise InvalidMessageError(f"{label} is an integer of more than 53 bits.", code="out_of_range")
    elif isinstance(value, str) and len(value) > MAX_TEXT:
        raise InvalidMessageError(f"{label} has {len(value)} letters (allowed {MAX_TEXT}).", code="out_of_range")
    elif isinstance(value, tuple):
        for item in value:
            _check_plain(item, label)


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """A pinhole camera, optical convention (x right, y down, z forward)."""

    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    fx: float
    """Focal length along x [px]."""
    fy: float
    """Focal length along y [px]."""
    cx: float
    """Principal point, column [px]; the centre of pixel (0, 0) is at 0.0."""
    cy: float
    """Principal point, row [px]."""

    def __post_init__(self) -> None:
        _freeze(self)

    @property
    def K(self) -> np.ndarray:
        """Camera matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2), column and row, of `points` (N, 3) in the camera frame, in front of it [m]."""
        x, y, z = points.T
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=1)

    def deproject(self, u: np.ndarray, v: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
        """Return the points (N, 3) in the camera frame of columns `u` and rows `v` (N,) at `depth_m` (N,) along z [m].

        Paper: x = (u − cx) z / fx, y = (v − cy) z / fy.
        """
        z = np.asarray(depth_m, dtype=float)
        points = np.empty((len(z), 3))
        points[:, 0] = (u - self.cx) * z / self.fx
        points[:, 1] = (v - self.cy) * z / self.fy
        points[:, 2] = z
        return points

    def rays(self) -> np.ndarray:
        """Return the direction (H, W, 3) of each pixel's ray in the camera frame, scaled to z = 1."""
        v, u = np.mgrid[: self.height, : self.width]
        return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)], axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RgbdFrame:
    """One exposure: colour and depth of the same instant, depth aligned to colour pixel by pixel."""

    colour: np.ndarray
    """(H, W, 3) uint8, RGB."""
    depth_m: np.ndarray
    """(H, W) float32 distance along the optical axis [m]; 0 = no measurement."""
    intrinsics: Intrinsics
    """Pinhole of both images."""
    stamp_s: float
    """Mid-exposure time [s]."""
    sequence: int
    """Frame number, which increases by one a frame; a gap means lost frames."""
    serial: str = ""
    """Serial number of the camera, by which its calibration is found; empty where unknown."""
    ground_truth_mask: np.ndarray | None = None
    """(H, W) bool, the target object's pixels. Only the twin fills it, for evaluation only."""

    def __post_init__(self) -> None:
        size = (self.intrinsics.height, self.intrinsics.width)
        _freeze(self, colour=(np.uint8, (*size, 3)), depth_m=(np.float32, size))
        if self.ground_truth_mask is not None:
            _freeze(self, ground_truth_mask=(np.bool_, size))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArmState:
    """Measurement of the arm."""

    stamp_s: float
    """Measurement time [s]."""
    q: np.ndarray
    """(7,) joint positions [rad]."""
    dq: np.ndarray
    """(7,) joint velocities [rad/s]."""
    tau: np.ndarray
    """(7,) joint torques applied by the motors [Nm]."""
    faults: tuple[str, ...] = ()
    """Present faults of the arm, as text; empty when healthy."""

    def __post_init__(self) -> None:
        _freeze(self, q=(float, (N_JOINTS,)), dq=(float, (N_JOINTS,)), tau=(float, (N_JOINTS,)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArmSetpoint:
    """Command for the next tick."""

    q: np.ndarray
    """(7,) joint positions [rad]."""
    dq: np.ndarray
    """(7,) joint velocities [rad/s]."""

    def __post_init__(self) -> None:
        _freeze(self, q=(float, (N_JOINTS,)), dq=(float, (N_JOINTS,)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrajectoryChunk:
    """A section of a joint trajectory, sent about 0.3 s before it is due.

    Trajectory time starts at 0 with the first point of the first chunk; the servo starts that clock when it accepts
    the chunk and pauses it when a tick is late, so sender and servo need no common clock. A trajectory begins and ends
    at rest. A chunk of a new trajectory replaces the rest of the old one: the arm stops on that, and goes to the new
    start.
    """

    trajectory_id: int
    """Identifier of the trajectory; a new one is greater than all before it."""
    t_s: np.ndarray
    """(N,) trajectory times [s], strictly increasing; the first continues where the last chunk ended."""
    q: np.ndarray
    """(N, 7) joint positions [rad]."""
    dq: np.ndarray
    """(N, 7) joint velocities [rad/s]."""
    final: bool = False
    """True on the last chunk, which ends at rest: the servo then holds its last point. Without it, the servo brakes
    before the buffer is empty."""

    def __post_init__(self) -> None:
        n = len(np.atleast_1d(self.t_s))
        if not 0 < n <= MAX_CHUNK_POINTS:
            raise InvalidMessageError(
                f"TrajectoryChunk.t_s has {n} times (allowed 1 to {MAX_CHUNK_POINTS}).", code="invalid_times"
            )
        _freeze(self, t_s=(float, (n,)), q=(float, (n, N_JOINTS)), dq=(float, (n, N_JOINTS)))
        if (np.diff(self.t_s) < MIN_SPACING_S).any() or self.t_s[0] < -MIN_SPACING_S:
            raise InvalidMessageError(
                f"TrajectoryChunk.t_s goes from {self.t_s[0]:.6g} to {self.t_s[-1]:.6g} s (allowed from 0, increasing "
                f"by at least {MIN_SPACING_S:g} s).",
                code="invalid_times",
            )
        if self.trajectory_id < 1:
            raise InvalidMessageError(
                f"TrajectoryChunk.trajectory_id is {self.trajectory_id} (allowed from 1).", code="out_of_range"
            )


class ServoMode(Enum):
    """Mode of the servo."""

    HOLDING = "holding"
    """Keeps the last commanded position."""
    TRACKING = "tracking"
    """Follows a trajectory or a single setpoint."""
    BRAKING = "braking"
    """Slows down within the limits, then holds."""
    STOPPED = "stopped"
    """Holds, and rejects all commands until it is re-armed."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ServoStatus:
    """Status of the servo, published with each arm state."""

    stamp_s: float
    """Time of the tick [s]."""
    mode: ServoMode
    """Mode after the tick."""
    reason: str
    """Reason for braking, for the stop, or for dropping the last trajectory; empty when there is none."""
    owner: str
    """Owner of the command lease; empty when it is free."""
    trajectory_id: int
    """Last trajectory begun or dropped; 0 before the first."""
    trajectory_time_s: float
    """Time reached on that trajectory [s]."""
    buffered_s: float
    """Duration of its buffered part that is not played yet [s]."""
    finished: bool
    """True when that trajectory was played to its end (not when it was dropped)."""
    q_command: np.ndarray
    """(7,) last setpoint sent to the arm, after the limits [rad]."""
    ticks: int
    """Ticks since the start."""
    overruns: int
    """Ticks that began more than half a period late."""
    period_ms_p50: float
    """Median of the last measured periods [ms]; 0 while unmeasured (lock-step)."""
    period_ms_p999: float
    """99.9th percentile of the same [ms]."""

    def __post_init__(self) -> None:
        _freeze(self, q_command=(float, (N_JOINTS,)))


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoHealth:
    """Health of the servo, published once a second; all figures are measured."""

    stamp_s: float
    """Time of the message [s]."""
    mode: ServoMode
    """Mode of the servo."""
    faults: tuple[str, ...]
    """Reason of the latched stop, or else the arm's faults; empty when there are none."""
    rate_hz: float
    """Ticks per second over the last minute; this and the periods are 0 while unmeasured (lock-step)."""
    period_ms_p50: float
    """Median of the last minute's periods [ms]."""
    period_ms_p99: float
    """99th percentile [ms]."""
    period_ms_p999: float
    """99.9th percentile [ms]."""
    period_ms_max: float
    """Maximum [ms]."""
    ticks: int
    """Ticks since the start."""
    overruns: int
    """Ticks that began more than half a period late."""
    owner: str
    """Owner of the command lease; empty when it is free."""
    command_age_s: float
    """Age of the owner's last command or heartbeat [s]; 0 while the lease is free."""
    real_time: tuple[str, ...]
    """Real-time resources granted to the servo's thread, such as SCHED_FIFO; empty = ordinary scheduling."""
    command_latency_ms_p50: float = 0.0
    """Median time from a command to the arm's answer to it [ms]; 0 where the arm does not measure it."""
    command_latency_ms_p99: float = 0.0
    """99th percentile of the same [ms]."""
    command_latency_ms_max: float = 0.0
    """Maximum of the same [ms]."""

    def __post_init__(self) -> None:
        _freeze(self)
