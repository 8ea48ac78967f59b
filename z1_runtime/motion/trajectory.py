"""Timed motions of arm and gripper: jerk-limited, at rest at both ends, inside the limits, sampled at 500 Hz.

A joint a hair beyond a limit is clipped to it, see `clip_joints`; further beyond is an error of the caller.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import ruckig
from scipy.interpolate import make_interp_spline

from hal.base import transforms, z1
from hal.base.errors import InvalidValueError, Z1Error
from z1_runtime.geometry.kinematics import POSITION_TOLERANCE_M, ROTATION_TOLERANCE_RAD, IkFailure, Kinematics
from z1_runtime.motion.limits import MotionLimits, clip_joints
from z1_runtime.types import JointTrajectory

_ROUNDING_RAD = 1e-9

_OVERSHOOT = 1e-6  # of the length; Ruckig's rounding

_ALREADY_THERE = 1e-6  # lines shorter than this are no lines [m, rad]
_WAYPOINT_SPACING_M = 0.005
_WAYPOINT_SPACING_RAD = 0.03
_MIN_WAYPOINTS = 12
_SPLINE_DEGREE = 5  # continuous jerk
_BULGE_RAD = 1e-8  # so little over a limit is clipped without a trace in the jerk
_STRETCH_MARGIN = 1.005  # the peaks between two samples; 1.5 % of the jerk


class PathFailure(Z1Error):
    """A straight motion without joints inside the limits; the message has the place along it and the reason.

    Attributes:
        fraction: place along the line at which it breaks, in [0, 1].
        joint: the joint at fault, or None.
    """

    default_code = "path"

    def __init__(self, message: str, *, fraction: float, joint: str | None = None) -> None:
        super().__init__(message)
        self.fraction = fraction
        self.joint = joint


def hold(q: np.ndarray, duration_s: float) -> JointTrajectory:
    """Hold `q` (7,) for `duration_s` [s], rounded up to whole control periods, at least one.

    Raises:
        ValueError: `q` is not a joint vector inside the limits, or `duration_s` is negative or not finite.
    """
    q = clip_joints(q, "q")
    if not 0.0 <= duration_s < np.inf:
        raise InvalidValueError(f"duration_s is {duration_s}; it must be finite and not negative.", code="duration")
    t_s = _sample_times(duration_s)
    return JointTrajectory(t_s=t_s, q=np.tile(q, (len(t_s), 1)), dq=np.zeros((len(t_s), z1.N_JOINTS)))


def joint_move(q_start: np.ndarray, q_goal: np.ndarray, limits: MotionLimits | None = None) -> JointTrajectory:
    """Move from rest at `q_start` (7,) to rest at `q_goal` (7,), straight in joint space.

    One Ruckig motion along the segment times all joints: Ruckig's own phase synchronisation leaves the segment where
    another joint's limit than the slowest one's would bind (observed: by 0.15 rad), and a collision check would have
    checked the wrong path.

    Raises:
        ValueError: a joint vector is outside the limits, or not finite.
    """
    q_start, q_goal = clip_joints(q_start, "q_start"), clip_joints(q_goal, "q_goal")
    limits = limits or MotionLimits()
    offset = q_goal - q_start
    length_rad = float(np.abs(offset).max())
    if length_rad < _ROUNDING_RAD:
        motion = hold(q_goal, 0.0)
        motion.q[0] = q_start
        return motion
    direction = offset / length_rad
    per_joint = np.array([limits.velocity, limits.acceleration, limits.jerk]) / np.maximum(np.abs(direction), 1e-12)
    t_s, along, speed, _, _ = _sample(_rest_to_rest(length_rad, per_joint.min(axis=1)))
    q = np.clip(q_start + along[:, None] * direction, z1.Q_MIN, z1.Q_MAX)
    q[0], q[-1] = q_start, q_goal
    return JointTrajectory(t_s=t_s, q=q, dq=speed[:, None] * direction)


def joint_path(qs: np.ndarray, limits: MotionLimits | None = None) -> JointTrajectory:
    """Move through `qs` (K, 7), at rest at each, so that the path between two is exactly the segment that was checked.

    Raises:
        ValueError: fewer than two points, or one outside the limits.
    """
    if len(qs) < 2:
        raise InvalidValueError(
            f"joint_path: {len(qs)} points are not enough. Give at least a start and a goal.", code="too_few_points"
        )
    return concatenate([joint_move(a, b, limits) for a, b in pairwise(qs)])


def gripper_move(q: np.ndarray, jaw_goal: float, limits: MotionLimits | None = None) -> JointTrajectory:
    """Move the gripper of `q` (7,) to `jaw_goal` [rad] while the arm is at rest.

    Raises:
        ValueError: `q` or `jaw_goal` is outside the limits, or not finite.
    """
    q_goal = np.array(q, dtype=np.float64)
    q_goal[-1:] = jaw_goal
    return joint_move(q, q_goal, limits)


def straight_move(  # noqa: PLR0917 - the order of the line itself: from, to, then how
    kinematics: Kinematics,
    T_start: np.ndarray,
    T_goal: np.ndarray,
    q_start: np.ndarray,
    jaw_goal: float | None = None,
    limits: MotionLimits | None = None,
) -> JointTrajectory:
    """Move the pivot in a straight line, turning evenly (LERP and SLERP), while the gripper goes to its own goal.

    Args:
        kinematics: of the arm.
        T_start: (4, 4) T_base_pivot to start from; the line begins exactly where `q_start` is, which must be within
            2 mm and 1° of it.
        T_goal: (4, 4) T_base_pivot to end at.
        q_start: (7,) joints at the start [rad].
        jaw_goal: jaw angle at the end [rad]; None keeps it.
        limits: joint and Cartesian limits, both hold all along.

    Raises:
        PathFailure: a point of the line has no joints inside the limits, or only after a jump.
        ValueError: `q_start` or `jaw_goal` outside the limits, `q_start` not at `T_start`, or not a pose.
    """
    limits = limits or MotionLimits()
    q_start = clip_joints(q_start, "q_start")
    q_goal = np.append(q_start[:-1], q_start[-1] if jaw_goal is None else jaw_goal)
    jaw_goal = float(clip_joints(q_goal, "the goal")[-1])
    T_goal = transforms.check_pose(T_goal, "T_goal")
    T_from = kinematics.pivot(q_start[: z1.N_ARM])
    _check_start(T_from, transforms.check_pose(T_start, "T_start"))

    length_m, angle_rad = transforms.pose_error(T_from, T_goal)
    if length_m < _ALREADY_THERE and angle_rad < _ALREADY_THERE:
        return gripper_move(q_start, jaw_goal, limits)
    spline = _joint_spline(kinematics, T_from, T_goal, q_start, jaw_goal)
    trajectory = _time_along(spline, length_m, angle_rad, limits)
    t_s, s, ds, _, _ = _sample(trajectory)
    s = np.clip(s, 0.0, 1.0)
    q = spline(s)
    q[0], q[-1, -1] = q_start, jaw_goal
    _check_inside(q, s)
    return JointTrajectory(t_s=t_s, q=np.clip(q, z1.Q_MIN, z1.Q_MAX), dq=spline(s, 1) * ds[:, None])


def concatenate(parts: list[JointTrajectory]) -> JointTrajectory:
    """Return the motions one after the other; each starts at rest where the one before it ended.

    Raises:
        ValueError: no parts, or a part starts somewhere else.
    """
    if not parts:
        raise InvalidValueError("there is nothing to concatenate; give at least one motion.", code="too_few_points")
    for before, after in pairwise(parts):
        gap = np.abs(after.q[0] - before.q[-1])
        if gap.max() > _ROUNDING_RAD:
            joint = int(gap.argmax())
            raise InvalidValueError(
                f"{z1.JOINT_NAMES[joint]} would jump by {gap[joint]:.6f} rad between two motions.", code="jump"
            )
    q = np.concatenate([parts[0].q, *(part.q[1:] for part in parts[1:])])
    dq = np.concatenate([parts[0].dq, *(part.dq[1:] for part in parts[1:])])
    return JointTrajectory(t_s=np.arange(len(q)) * z1.CONTROL_PERIOD_S, q=q, dq=dq)


# --- Timing -----------------------------------------------------------------------------------------------


def _rest_to_rest(length: float, fastest: np.ndarray) -> ruckig.Trajectory:
    """Return Ruckig's time-optimal motion from 0 to `length` under `fastest` = (velocity, acceleration, jerk) limits.

    Waypoints are never given to Ruckig: its wheel sends them to a web service.
    """
    request = ruckig.InputParameter(1)
    request.current_position, request.target_position = [0.0], [length]
    request.max_velocity, request.max_acceleration, request.max_jerk = ([float(limit)] for limit in fastest)
    trajectory = ruckig.Trajectory(1)
    result = ruckig.Ruckig(1).calculate(request, trajectory)
    if result != ruckig.Result.Working:
        raise RuntimeError(f"Ruckig returned {result} for {request}")
    # Ruckig takes position limits and ignores them, so what it found is checked here
    extrema = trajectory.position_extrema[0]
    if extrema.min < -_OVERSHOOT * length or extrema.max > (1.0 + _OVERSHOOT) * length:
        raise RuntimeError(f"Ruckig goes from {extrema.min} to {extrema.max} for {request}")
    return trajectory


def _sample_times(duration_s: float) -> np.ndarray:
    n_periods = max(1, int(np.ceil(duration_s / z1.CONTROL_PERIOD_S - 1e-9)))
    return np.arange(n_periods + 1) * z1.CONTROL_PERIOD_S


def _sample(trajectory: ruckig.Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return times, and position, velocity, acceleration and jerk along the path, each (N,), at the control period.

    The motion is slowed by less than one period in all, so that the last sample is its end.
    """
    t_s = _sample_times(trajectory.duration)
    pace = trajectory.duration / t_s[-1]
    samples = np.array([trajectory.at_time(t)[:3] for t in (t_s * pace).tolist()])[:, :, 0]
    position, velocity, acceleration = samples[:, 0], samples[:, 1] * pace, samples[:, 2] * pace**2
    velocity[[0, -1]] = 0.0
    jerk = np.diff(acceleration, append=0.0) / z1.CONTROL_PERIOD_S
    return t_s, position, velocity, acceleration, jerk


# --- Straight lines ---------------------------------------------------------------------------------------


def _joint_spline(
    kinematics: Kinematics, T_from: np.ndarray, T_goal: np.ndarray, q_start: np.ndarray, jaw_goal: float
) -> Callable[..., np.ndarray]:
    """Return q(s), (7,) for s in [0, 1], through the inverse kinematics of closely spaced waypoints."""
    length_m, angle_rad = transforms.pose_error(T_from, T_goal)
    n_steps = int(np.ceil(max(length_m / _WAYPOINT_SPACING_M, angle_rad / _WAYPOINT_SPACING_RAD, _MIN_WAYPOINTS - 1)))
    s = np.linspace(0.0, 1.0, n_steps + 1)
    Ts = transforms.interpolate(T_from, T_goal, s)
    q_arm = q_start[: z1.N_ARM]
    try:
        # The start is known; solving it again would fail where a singular start has a circle of solutions
        qs_arm = np.vstack([q_arm, kinematics.follow(Ts[1:], q_arm)])
    except IkFailure as failure:
        fraction = ((failure.waypoint or 0) + 1) / n_steps
        raise PathFailure(
            f"the straight line of {length_m * 1e3:.0f} mm and {np.rad2deg(angle_rad):.0f}° breaks at "
            f"{100 * fraction:.0f} %: {failure}",
            fraction=fraction,
            joint=failure.joint,
        ) from failure
    jaw = q_start[-1] + s * (jaw_goal - q_start[-1])
    return make_interp_spline(s, np.column_stack([qs_arm, jaw]), k=_SPLINE_DEGREE)


def _time_along(
    spline: Callable[..., np.ndarray], length_m: float, angle_rad: float, limits: MotionLimits
) -> ruckig.Trajectory:
    """Return s(t) from 0 to 1, as fast as the Cartesian limits allow, slowed evenly until the joints' hold too."""
    slopes = np.abs(spline(np.linspace(0.0, 1.0, 200), 1)).max(axis=0)
    per_joint = np.array([limits.velocity, limits.acceleration, limits.jerk]) / np.maximum(slopes, _ROUNDING_RAD)
    linear = np.array([limits.linear_velocity, limits.linear_acceleration, limits.linear_jerk])
    angular = np.array([limits.angular_velocity, limits.angular_acceleration, limits.angular_jerk])
    fastest = np.minimum(per_joint.min(axis=1), linear / max(length_m, _ROUNDING_RAD))
    fastest = np.minimum(fastest, angular / max(angle_rad, _ROUNDING_RAD))
    trajectory = _rest_to_rest(1.0, fastest)

    _, s, *rates = _sample(trajectory)
    ds, dds, ddds = (rate[:, None] for rate in rates)
    q1, q2, q3 = (spline(np.clip(s, 0.0, 1.0), order) for order in (1, 2, 3))
    velocity = np.abs(q1 * ds / limits.velocity).max()
    acceleration = np.abs((q1 * dds + q2 * ds**2) / limits.acceleration).max()
    jerk = np.abs((q1 * ddds + 3.0 * q2 * ds * dds + q3 * ds**3) / limits.jerk).max()
    stretch = _STRETCH_MARGIN * max(velocity, np.sqrt(acceleration), np.cbrt(jerk))
    if stretch <= 1.0:
        return trajectory
    # s(t / stretch) has its n-th derivative divided by stretchⁿ, and so have the joints
    return _rest_to_rest(1.0, fastest / stretch ** np.arange(1, 4))


# --- Checks -----------------------------------------------------------------------------------------------


def _check_start(T_from: np.ndarray, T_start: np.ndarray) -> None:
    distance_m, angle_rad = transforms.pose_error(T_from, T_start)
    if distance_m > POSITION_TOLERANCE_M or angle_rad > ROTATION_TOLERANCE_RAD:
        raise InvalidValueError(
            f"q_start puts the pivot {distance_m * 1e3:.1f} mm and {np.rad2deg(angle_rad):.1f}° from T_start; "
            f"allowed is {POSITION_TOLERANCE_M * 1e3:.0f} mm and {np.rad2deg(ROTATION_TOLERANCE_RAD):.0f}°.",
            code="start_pose",
        )


def _check_inside(q: np.ndarray, s: np.ndarray) -> None:
    """Reject a spline that bulges over a limit between two waypoints that are inside."""
    excess = np.maximum(z1.Q_MIN - q, q - z1.Q_MAX)
    row, joint = np.unravel_index(int(excess.argmax()), excess.shape)
    if excess[row, joint] > _BULGE_RAD:
        raise PathFailure(
            f"{z1.JOINT_NAMES[joint]} would be {q[row, joint]:.4f} rad at {100 * s[row]:.0f} % of the straight line; "
            f"allowed is {z1.Q_MIN[joint]:.4f} to {z1.Q_MAX[joint]:.4f} rad.",
            fraction=float(s[row]),
            joint=z1.JOINT_NAMES[joint],
        )
