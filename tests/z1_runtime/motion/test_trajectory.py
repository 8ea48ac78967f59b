"""Motions start and end in place, at rest, and keep every limit."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from hal.base import transforms, z1
from hal.base.errors import InvalidValueError
from tests.support.errors import raises
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.motion import trajectory
from z1_runtime.motion.limits import LIMIT_TOLERANCE_RAD
from z1_runtime.motion.trajectory import MotionLimits, PathFailure
from z1_runtime.types import JointTrajectory

KINEMATICS = Kinematics()
FRACTIONS = hnp.arrays(np.float64, z1.N_JOINTS, elements=st.floats(0.0, 1.0))
SPEEDS = st.floats(0.05, 1.0)
Q_READY = np.array([0.0, 1.5, -1.3, -0.2, 0.0, 1.57, -1.2])
RELATIVE = 0.01


def joints(fraction: np.ndarray) -> np.ndarray:
    return z1.Q_MIN + fraction * (z1.Q_MAX - z1.Q_MIN)


def assert_sound(motion: JointTrajectory, limits: MotionLimits) -> None:
    """Sampled each control period, at rest at both ends, and inside all limits by finite differences."""
    dt = z1.CONTROL_PERIOD_S
    np.testing.assert_allclose(motion.t_s, np.arange(len(motion.t_s)) * dt, atol=1e-12)
    assert motion.q.shape == motion.dq.shape == (len(motion.t_s), z1.N_JOINTS)
    assert (motion.q >= z1.Q_MIN - 1e-9).all()
    assert (motion.q <= z1.Q_MAX + 1e-9).all()
    np.testing.assert_array_equal(motion.dq[[0, -1]], 0.0)
    # At rest before and after
    q = np.concatenate([motion.q[:1]] * 3 + [motion.q] + [motion.q[-1:]] * 3)
    velocity = np.diff(q, axis=0) / dt
    acceleration = np.diff(velocity, axis=0) / dt
    jerk = np.diff(acceleration, axis=0) / dt
    assert (np.abs(motion.dq) <= limits.velocity * (1 + RELATIVE)).all()
    assert (np.abs(velocity) <= limits.velocity * (1 + RELATIVE)).all()
    assert (np.abs(acceleration) <= limits.acceleration * (1 + RELATIVE)).all()
    assert (np.abs(jerk) <= limits.jerk * (1 + RELATIVE)).all()
    midpoint = 0.5 * (motion.dq[1:] + motion.dq[:-1])
    np.testing.assert_allclose(np.diff(motion.q, axis=0) / dt, midpoint, atol=1e-3)


@pytest.mark.integration
@settings(max_examples=60)
@given(FRACTIONS, FRACTIONS, SPEEDS)
def test_a_joint_move_goes_straight_and_keeps_all_limits(start: np.ndarray, goal: np.ndarray, speed: float) -> None:
    q_start, q_goal, limits = joints(start), joints(goal), MotionLimits.at_speed(speed)
    motion = trajectory.joint_move(q_start, q_goal, limits)
    assert_sound(motion, limits)
    np.testing.assert_array_equal(motion.q[0], q_start)
    np.testing.assert_array_equal(motion.q[-1], q_goal)
    offset = q_goal - q_start
    along = (motion.q - q_start) @ offset / max(offset @ offset, 1e-12)
    np.testing.assert_allclose(motion.q, q_start + along[:, None] * offset, atol=1e-6)


def test_a_joint_move_is_as_fast_as_its_slowest_limit() -> None:
    q_start, q_goal = np.append(z1.Q_HOME, 0.0), np.append(z1.Q_HOME, 0.0)
    q_goal[0] = 2.0
    motion = trajectory.joint_move(q_start, q_goal, MotionLimits.at_speed(1.0))
    assert np.abs(motion.dq[:, 0]).max() == pytest.approx(z1.DQ_MAX[0], rel=2e-3)
    # A motion that reaches full speed and full acceleration takes d/v + v/a + a/j
    velocity, acceleration, jerk = z1.DQ_MAX[0], z1.DDQ_MAX[0], z1.DDDQ_MAX[0]
    by_hand = 2.0 / velocity + velocity / acceleration + acceleration / jerk
    assert by_hand <= motion.duration_s <= by_hand + z1.CONTROL_PERIOD_S


@pytest.mark.integration
@settings(max_examples=40)
@given(
    hnp.arrays(np.float64, 6, elements=st.floats(-0.2, 0.2)),
    hnp.arrays(np.float64, 3, elements=st.floats(-0.06, 0.06)),
    hnp.arrays(np.float64, 3, elements=st.floats(-0.3, 0.3)),
    st.floats(z1.GRIPPER_OPEN, z1.GRIPPER_CLOSED),
    SPEEDS,
)
def test_a_straight_move_goes_straight_and_keeps_all_limits(
    offset: np.ndarray, shift_m: np.ndarray, turn: np.ndarray, jaw_goal: float, speed: float
) -> None:
    limits, q_start = MotionLimits.at_speed(speed), Q_READY + np.append(offset, 0.0)
    T_start = KINEMATICS.pivot(q_start[:6])
    T_goal = T_start @ transforms.make_pose(Rotation.from_rotvec(turn).as_matrix(), shift_m)
    try:
        motion = trajectory.straight_move(KINEMATICS, T_start, T_goal, q_start, jaw_goal, limits)
    except PathFailure:
        assume(False)
        raise
    assert_sound(motion, limits)
    np.testing.assert_array_equal(motion.q[0], q_start)
    assert motion.q[-1, -1] == pytest.approx(jaw_goal, abs=1e-9)
    Ts = np.stack([KINEMATICS.pivot(q[:6]) for q in motion.q[:: max(1, len(motion.q) // 40)]] + [T_goal])
    assert max(transforms.pose_error(KINEMATICS.pivot(motion.q[-1, :6]), T_goal)) < 1e-6
    # The larger of the two errors gives the progress of each along the line
    length_m, angle_rad = transforms.pose_error(T_start, T_goal)
    if max(length_m, angle_rad) > 1e-3:
        progress = [max(transforms.pose_error(T_start, T)) / max(length_m, angle_rad) for T in Ts]
        on_line = transforms.interpolate(T_start, T_goal, np.array(progress))
        assert max(max(transforms.pose_error(T, wanted)) for T, wanted in zip(Ts, on_line, strict=True)) < 2e-4


def test_a_straight_move_keeps_the_cartesian_limits() -> None:
    limits = MotionLimits(linear_velocity=0.05)
    T_start = KINEMATICS.pivot(Q_READY[:6])
    T_goal = T_start.copy()
    T_goal[:3, 3] += 0.10, 0.0, 0.0
    motion = trajectory.straight_move(KINEMATICS, T_start, T_goal, Q_READY, limits=limits)
    p = np.stack([KINEMATICS.pivot(q[:6])[:3, 3] for q in motion.q])
    speed = np.linalg.norm(np.diff(p, axis=0), axis=1) / z1.CONTROL_PERIOD_S
    assert 0.045 < speed.max() < 0.05 * (1 + 1e-3)
    np.testing.assert_allclose(motion.q[:, -1], Q_READY[-1], atol=1e-12)


def test_a_straight_move_out_of_reach_says_where_and_why() -> None:
    T_start = KINEMATICS.pivot(Q_READY[:6])
    T_goal = T_start.copy()
    T_goal[:3, 3] += 0.8, 0.0, 0.0
    with raises(PathFailure, "path") as failure:
        trajectory.straight_move(KINEMATICS, T_start, T_goal, Q_READY)
    fraction = failure.value.fraction  # pyright: ignore[reportAttributeAccessIssue]
    broken = transforms.interpolate(T_start, T_goal, np.array([fraction, fraction - 0.01]))
    assert KINEMATICS.solve(broken[0]) == []
    assert KINEMATICS.solve(broken[1]) != []


def test_a_straight_move_from_somewhere_else_is_rejected() -> None:
    T_start = KINEMATICS.pivot(Q_READY[:6])
    T_start[0, 3] += 0.01
    with raises(InvalidValueError, "start_pose"):
        trajectory.straight_move(KINEMATICS, T_start, T_start, Q_READY)


def test_a_straight_move_to_where_the_pivot_is_moves_the_gripper_alone() -> None:
    T = KINEMATICS.pivot(Q_READY[:6])
    motion = trajectory.straight_move(KINEMATICS, T, T, Q_READY, -0.4)
    np.testing.assert_array_equal(motion.q[:, :6], np.tile(Q_READY[:6], (len(motion.q), 1)))
    assert motion.q[-1, -1] == -0.4


@settings(max_examples=15)
@given(st.lists(FRACTIONS, min_size=2, max_size=4))
def test_a_joint_path_stops_at_each_point(fractions: list[np.ndarray]) -> None:
    qs = np.stack([joints(fraction) for fraction in fractions])
    motion = trajectory.joint_path(qs)
    assert_sound(motion, MotionLimits())
    np.testing.assert_array_equal(motion.q[[0, -1]], qs[[0, -1]])
    for q in qs:
        here = (motion.q == q).all(axis=1)
        assert here.any()
        np.testing.assert_array_equal(motion.dq[here], 0.0)


def test_a_gripper_move_leaves_the_arm_alone() -> None:
    motion = trajectory.gripper_move(Q_READY, -0.2)
    assert_sound(motion, MotionLimits())
    np.testing.assert_array_equal(motion.q[:, :6], np.tile(Q_READY[:6], (len(motion.q), 1)))
    assert motion.q[-1, -1] == -0.2


def test_holding_lasts_whole_periods() -> None:
    motion = trajectory.hold(Q_READY, 0.1011)
    assert_sound(motion, MotionLimits())
    assert motion.duration_s == pytest.approx(0.102)
    assert trajectory.hold(Q_READY, 0.0).duration_s == z1.CONTROL_PERIOD_S


def test_moving_to_where_the_arm_is_takes_one_period() -> None:
    motion = trajectory.joint_move(Q_READY, Q_READY)
    assert motion.duration_s == z1.CONTROL_PERIOD_S
    np.testing.assert_array_equal(motion.q, [Q_READY, Q_READY])


@pytest.mark.integration
@settings(max_examples=30)
@given(FRACTIONS, FRACTIONS, st.sampled_from([0.02, 0.1, 0.2]))
def test_the_parts_of_a_motion_cover_every_sample_once(start: np.ndarray, goal: np.ndarray, length_s: float) -> None:
    motion = trajectory.joint_move(joints(start), joints(goal))
    covered = [i for part in motion.split(length_s) for i in range(part.start, part.stop)]
    assert covered == list(range(len(motion.t_s)))


@pytest.mark.parametrize("value", [3.1, -0.1, np.nan, np.inf])
@pytest.mark.parametrize("end", ["q_start", "q_goal"])
def test_joints_outside_the_limits_are_rejected_by_name(end: str, value: float) -> None:
    wrong = Q_READY.copy()
    wrong[1] = value
    q_start, q_goal = (wrong, Q_READY) if end == "q_start" else (Q_READY, wrong)
    with raises(InvalidValueError, "joint_limit") as caught:
        trajectory.joint_move(q_start, q_goal)
    assert f"{end}: joint2 is {value:.4f} rad; allowed is 0.0000 to 2.9671 rad" in str(caught.value)


BEYOND_RAD = st.floats(0.0, LIMIT_TOLERANCE_RAD)


@pytest.mark.integration
@given(hnp.arrays(np.bool_, z1.N_JOINTS), BEYOND_RAD, BEYOND_RAD)
def test_joints_a_hair_beyond_the_limits_are_clipped(upper: np.ndarray, start_rad: float, goal_rad: float) -> None:
    at_limit, sign = np.where(upper, z1.Q_MAX, z1.Q_MIN), np.where(upper, 1.0, -1.0)
    motion = trajectory.joint_move(at_limit + start_rad * sign, at_limit + goal_rad * sign)
    np.testing.assert_array_equal(motion.q[[0, -1]], [at_limit, at_limit])
    held = trajectory.hold(at_limit + start_rad * sign, 0.01)
    np.testing.assert_array_equal(held.q[0], at_limit)


@given(st.floats(z1.GRIPPER_OPEN - 0.005, 0.005), st.floats(-12.0, -3.0), st.booleans())
def test_jaw_moves_of_every_length_and_at_every_edge_never_raise(start: float, exponent: float, opening: bool) -> None:
    q = np.append(Q_READY[:6], start)
    goal = np.clip(start + (-1.0 if opening else 1.0) * 10.0**exponent, z1.GRIPPER_OPEN - 0.005, 0.005)
    motion = trajectory.gripper_move(q, float(goal))
    assert ((motion.q[:, -1] >= z1.GRIPPER_OPEN) & (motion.q[:, -1] <= z1.GRIPPER_CLOSED)).all()
    assert motion.q[-1, -1] == np.clip(goal, z1.GRIPPER_OPEN, z1.GRIPPER_CLOSED)


def test_a_jaw_goal_outside_the_limits_is_rejected() -> None:
    T = KINEMATICS.pivot(Q_READY[:6])
    with raises(InvalidValueError, "joint_limit"):
        trajectory.straight_move(KINEMATICS, T, T, Q_READY, 0.3)
    with raises(InvalidValueError, "joint_limit"):
        trajectory.gripper_move(Q_READY, 0.3)


def test_limits_above_the_arm_are_rejected() -> None:
    with raises(InvalidValueError, "invalid_value"):
        MotionLimits(velocity=1.1 * z1.DQ_MAX)
    with raises(InvalidValueError, "invalid_value"):
        MotionLimits(linear_jerk=0.0)
    with raises(InvalidValueError, "invalid_value"):
        MotionLimits.at_speed(1.5)


def test_motions_that_do_not_join_are_not_concatenated() -> None:
    elsewhere = Q_READY.copy()
    elsewhere[3] += 0.1
    with raises(InvalidValueError, "jump"):
        trajectory.concatenate([trajectory.hold(Q_READY, 0.1), trajectory.hold(elsewhere, 0.1)])


def test_nothing_asks_ruckig_for_waypoints_which_it_would_send_to_a_web_service() -> None:
    root = Path(trajectory.__file__).parents[1]
    for path in [*root.glob("z1_runtime/**/*.py"), *root.glob("hal/**/*.py")]:
        names = {node.attr for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.Attribute)}
        assert "intermediate_positions" not in names, path.name
